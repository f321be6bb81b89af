"use strict";

// Editing mode of a report: selection of several objects, list of edits, download of edits.json.

class EditingMode {
  /** `page` shows `page.shown()`; the editing mode changes it with `page.show()` and `page.select()`. */
  constructor(page) {
    this.page = page;
    this.on = false;
    this.edits = [];
    this.selection = []; // ids of instances, in order of selection
    this.latest = null; // id of the latest selected object, whose details are shown
    this.saved = editsFile([]); // content of the latest downloaded file
    this.edited = new EditedInstances(report.objects, []);
    byId("edit-classes").append(...report.edit.classes.map((name) => {
      const option = made("option");
      option.value = name;
      return option;
    }));
    byId("edit-name").maxLength = LONGEST_CLASS_NAME;
    byId("edit-command").textContent = report.edit.command;
    this.listen();
  }

  listen() {
    const on = (id, event, action) => byId(id).addEventListener(event, action);
    on("edit", "click", () => this.turn(!this.on));
    on("edit-close", "click", () => { this.turn(false); byId("edit").focus(); });
    on("edit-merge", "click", () => this.add({ merge: this.selection }));
    on("edit-delete", "click", () => this.add({ delete: this.selection }));
    for (const by of Object.keys(SPLITS)) on(`edit-${by}`, "click", () => this.add({ split: [this.selection[0], by] }));
    on("edit-name", "input", () => this.buttons());
    on("edit-form", "submit", (event) => {
      event.preventDefault();
      if (this.edited.refusal("rename", this.selection, this.className)) return;
      this.add({ rename: [this.selection[0], this.className] });
      byId("edit-name").value = "";
      this.buttons();
    });
    on("edit-undo", "click", () => this.remove(this.edits.length - 1));
    on("edit-save", "click", () => this.save());
    document.addEventListener("keydown", (event) => {
      if (this.on && event.key === "Escape") this.clear();
    });
    addEventListener("beforeunload", (event) => {
      if (this.edits.length && editsFile(this.edits) !== this.saved) event.preventDefault(); // the browser asks before discarding the edits
    });
  }

  get className() { return byId("edit-name").value.trim(); }

  /** Turns the editing mode on or off. The edits are kept, but only shown in the editing mode. */
  turn(on) {
    this.on = on;
    this.selection = [];
    this.latest = null;
    byId("edit").setAttribute("aria-pressed", on);
    byId("editor").hidden = !on;
    this.page.choose(null);
    const { viewer } = this.page;
    if (viewer && on) this.viewBefore = viewer.view;
    if (viewer) this.page.setView(on ? "instance" : this.viewBefore); // merged instances have a common color there
    this.refresh();
  }

  add(edit) {
    this.edits = [...this.edits, edit];
    this.refresh();
  }

  remove(number) {
    this.edits = this.edits.filter((_, k) => k !== number);
    this.refresh();
  }

  /** Selects the instance that contains an object, or removes it from the selection. */
  toggle(id) {
    const owner = this.edited.owners.get(id);
    if (!owner) return;
    const selected = this.selection.includes(owner.id);
    this.selection = selected ? this.selection.filter((one) => one !== owner.id) : [...this.selection, owner.id];
    this.latest = selected ? null : id;
    this.show();
  }

  clear() {
    this.selection = [];
    this.latest = null;
    this.show();
  }

  /** Computes the instances from the edits, and shows them. */
  refresh() {
    this.edited = new EditedInstances(report.objects, this.edits);
    this.selection = this.selection.filter((id) => this.edited.instances.has(id));
    if (!this.edited.owners.has(this.latest)) this.latest = null;
    this.page.show();
    this.list();
    this.show();
  }

  /** Shows the selection. */
  show() {
    if (!this.on) return;
    const { instances } = this.edited;
    const members = this.selection.flatMap((id) => instances.get(id).members);
    const labeled = this.page.shown().filter((one) => one.owner === one.id && (one.edited || this.selection.includes(one.id)));
    const texts = new Map(labeled.map((one) => [one.id, `${one.class} ${one.id}`]));
    this.page.select(members, this.latest, texts);
    const names = this.selection.map((id) => `${this.edited.name(id)} ${id}`);
    byId("edit-selection").textContent = names.length
      ? `Selected: ${names.join(", ")}`
      : "Select objects with a click in the map or the table. A second click deselects.";
    this.buttons();
  }

  buttons() {
    const set = (id, reason, title) => {
      byId(id).disabled = Boolean(reason);
      byId(id).title = reason || title;
    };
    const { selection } = this;
    const refusal = (operation, name) => this.edited.refusal(operation, selection, name);
    set("edit-merge", refusal("merge"), `Merge into ${selection[0]}, the first selected object`);
    set("edit-parts", refusal("split"), "Split into connected parts");
    set("edit-plane", refusal("split"), "Separate the dominant plane, such as a table top, from the rest");
    set("edit-rename", refusal("rename", this.className), "Set the class");
    set("edit-delete", refusal("delete"), "Change to background");
    const none = this.edits.length ? "" : "There are no edits";
    set("edit-undo", none, "Remove the last edit");
    set("edit-save", none, "Download the edits");
  }

  list() {
    byId("edit-list").replaceChildren(...this.edits.map((edit, k) => {
      const button = made("button", "", "×");
      button.type = "button";
      button.title = "Remove this edit";
      button.setAttribute("aria-label", `Remove edit ${k + 1}: ${editText(edit)}`);
      button.addEventListener("click", () => this.remove(k));
      const isNew = edit.rename && !report.edit.classes.includes(edit.rename[1]);
      const text = made("span", "", editText(edit));
      if (isNew) text.append(made("span", "faint", " (new class)"));
      return made("li", "", text, button);
    }));
    byId("edit-list").scrollTop = byId("edit-list").scrollHeight;
    byId("edit-splits").hidden = !this.edits.some((edit) => edit.split);
    byId("edit-apply").hidden = !this.edits.length || editsFile(this.edits) !== this.saved;
  }

  save() {
    this.saved = editsFile(this.edits);
    download(this.saved, "application/json", "edits.json");
    this.list();
  }
}
