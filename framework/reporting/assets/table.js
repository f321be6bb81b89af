"use strict";

// Object table with sortable columns, selectable rows and a search filter.

class ObjectTable {
  constructor(table, onChoose) {
    this.body = table.tBodies[0];
    this.rows = [...this.body.rows];
    this.heads = [...table.tHead.rows[0].cells];
    this.heads.forEach((head, column) => {
      const button = head.querySelector("button");
      if (button) button.addEventListener("click", () => this.sort(column));
    });
    this.body.addEventListener("click", (event) => {
      const row = event.target.closest("tr");
      if (row) onChoose(Number(row.dataset.id));
    });
    this.body.addEventListener("keydown", (event) => {
      const row = event.target.closest("tr");
      if (event.key === "Enter" || event.key === " ") onChoose(Number(row.dataset.id));
      else if (event.key === "ArrowDown") this.focusFrom(row, 1);
      else if (event.key === "ArrowUp") this.focusFrom(row, -1);
      else return;
      event.preventDefault();
    });
  }

  /** Sorts by a column: numbers in descending order, texts in ascending order. A second call reverses the order. */
  sort(column) {
    const head = this.heads[column];
    const numeric = head.classList.contains("number");
    const before = head.getAttribute("aria-sort");
    const first = numeric ? "descending" : "ascending";
    const order = before === first ? (numeric ? "ascending" : "descending") : first;
    this.heads.forEach((one) => one.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", order);
    const value = (row) => row.cells[column].dataset.value;
    const sign = order === "ascending" ? 1 : -1;
    this.rows.sort((a, b) => sign * (numeric ? value(a) - value(b) : value(a).localeCompare(value(b), "en", { numeric: true })));
    this.body.append(...this.rows);
  }

  /** Hides rows that do not match the search text, and dims rows below the probability. Returns the number of shown rows. */
  filter(words, probability) {
    let shown = 0;
    for (const row of this.rows) {
      const found = row.dataset.words.includes(words) || row.dataset.id === words;
      row.hidden = !found;
      row.classList.toggle("unlikely", Number(row.dataset.exists) < probability);
      shown += found;
    }
    return shown;
  }

  /** Shows the names, colors and changes of objects. Deleted objects are marked. */
  show(objects) {
    const byId = new Map(objects.map((one) => [one.id, one]));
    for (const row of this.rows) {
      const one = byId.get(Number(row.dataset.id));
      const cell = row.querySelector(".name");
      row.dataset.words = one.class.toLowerCase();
      row.classList.toggle("deleted", Boolean(one.deleted));
      cell.dataset.value = `${one.class} ${String(one.id).padStart(8, "0")}`;
      cell.querySelector("b").textContent = one.class;
      cell.querySelector(".swatch rect").setAttribute("fill", one.color);
      cell.querySelector("small")?.remove();
      if (one.note) cell.append(made("small", "", one.note));
    }
  }

  /** Marks the rows of the objects with these ids as selected. */
  choose(ids, scroll) {
    for (const row of this.rows) {
      const chosen = ids.includes(Number(row.dataset.id));
      row.setAttribute("aria-selected", chosen);
      if (chosen && scroll) row.scrollIntoView({ block: "nearest" });
    }
  }

  focusFrom(row, step) {
    const shown = this.rows.filter((one) => !one.hidden);
    const next = shown[shown.indexOf(row) + step];
    if (next) next.focus();
  }

  picture(id) {
    const row = this.rows.find((one) => Number(one.dataset.id) === id);
    return row && row.querySelector("img");
  }
}
