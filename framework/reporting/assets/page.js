"use strict";

// Controller of a page, which connects the map, the side panel, the object table and the buttons.

const report = JSON.parse(document.getElementById("report-data").textContent);
const byId = (id) => document.getElementById(id);

/** Returns an HTML element with texts or child elements. Texts are never parsed as markup. */
function made(name, css, ...children) {
  const element = document.createElement(name);
  if (css) element.className = css;
  element.append(...children);
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

function drawn(name, attributes, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

function swatch(color) {
  return drawn("svg", { class: "swatch", viewBox: "0 0 1 1", "aria-hidden": "true" },
    drawn("rect", { width: 1, height: 1, fill: color }));
}

function meter(share) {
  return drawn("svg", { class: "meter", viewBox: "0 0 100 10", preserveAspectRatio: "none", "aria-hidden": "true" },
    drawn("rect", { class: "meter-all", width: 100, height: 10 }),
    drawn("rect", { class: "meter-part", width: 100 * share, height: 10 }));
}

/** Downloads a content (text or ArrayBuffer) as a file. */
function download(content, type, name) {
  const link = made("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

class Page {
  constructor() {
    this.objects = new Map((report.objects || []).map((one) => [one.id, one]));
    const table = byId("objects-table");
    this.table = table && new ObjectTable(table, (id) => this.choose(id, { fly: true }));
    this.viewer = null;
    this.editing = byId("editor") && new EditingMode(this);
    this.confidence = report.likely;
    if (byId("canvas")) this.startViewer();
    else this.ready();
    document.querySelectorAll(".card[data-id]").forEach((card) => {
      card.addEventListener("click", () => this.choose(Number(card.dataset.id), { fly: true }));
    });
    const search = byId("search");
    if (search) search.addEventListener("input", () => this.filter());
    this.filter();
  }

  async startViewer() {
    try {
      const viewer = new MapViewer(byId("canvas"), (id) => this.choose(id));
      this.glbs = [];
      for (const [k, data] of report.maps.entries()) {
        const content = await unpacked(byId(`map-${k}`));
        this.glbs.push(content.slice(0));
        await viewer.add(content, data);
      }
      this.viewer = viewer;
    } catch (error) {
      document.querySelector(".viewer").classList.add("no-webgl");
      byId("panel").firstElementChild.textContent = `The 3D view is not available (${error.message}); showing an image.`;
      this.legend();
      this.ready();
      return;
    }
    this.map = 0;
    this.buttons();
    this.viewer.resize();
    this.viewer.show(0);
    this.viewer.setConfidence(this.confidence);
    this.legend();
    this.setTime(1000);
    this.ready();
  }

  ready() {
    if (this.editing) byId("edit").hidden = false;
    document.body.dataset.ready = "true";
  }

  buttons() {
    document.querySelectorAll("[data-view]").forEach((button) => {
      button.addEventListener("click", () => this.setView(button.dataset.view));
    });
    const maps = [...document.querySelectorAll("[data-map]")];
    maps.forEach((button) => button.addEventListener("click", () => {
      maps.forEach((one) => one.setAttribute("aria-pressed", one === button));
      this.map = Number(button.dataset.map);
      this.viewer.show(this.map, { keepView: report.sameWorld });
      this.legend();
    }));
    byId("path").addEventListener("change", (event) => this.viewer.setPath(event.target.checked));
    byId("confidence").addEventListener("input", (event) => {
      this.confidence = Number(event.target.value);
      byId("confidence-value").textContent = this.confidence.toFixed(2);
      this.viewer.setConfidence(this.confidence);
      this.legend();
      this.filter();
    });
    byId("reset").addEventListener("click", () => this.viewer.reset());
    byId("save").addEventListener("click", () => this.save());
    byId("time").addEventListener("input", (event) => this.setTime(Number(event.target.value)));
    byId("play").addEventListener("click", () => this.play());
  }

  setView(view) {
    document.querySelectorAll("[data-view]").forEach((one) => one.setAttribute("aria-pressed", one.dataset.view === view));
    this.viewer.setView(view);
    this.legend();
  }

  setTime(thousandths) {
    const { frames } = report.maps[this.map || 0];
    byId("time").value = thousandths;
    this.viewer.setTime(thousandths >= 1000 ? 1 : thousandths / 1000);
    const step = Math.min(frames.length - 1, Math.floor((thousandths / 1000) * frames.length));
    byId("time-value").textContent = frames.length ? `frame ${frames[step]}` : "no trajectory";
  }

  play() {
    const start = performance.now();
    const playing = (this.playing = {});
    const step = (now) => {
      if (this.playing !== playing) return;
      const share = Math.min(1, Math.max(0, (now - start) / 6000));
      this.setTime(Math.round(1000 * share));
      if (share < 1) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  save() {
    download(this.glbs[this.map], "model/gltf-binary", `${report.maps[this.map].name.replace(/[^\w.-]+/g, "_")}.glb`);
  }

  filter() {
    if (!this.table) return;
    const words = byId("search").value.trim().toLowerCase();
    const shown = this.table.filter(words, this.confidence);
    const likely = this.table.rows.filter((row) => Number(row.dataset.exists) >= this.confidence).length;
    byId("count").textContent = words
      ? `${shown} of ${this.table.rows.length} objects`
      : `${likely} objects with a probability of at least ${this.confidence.toFixed(2)}; the other rows are dimmed`;
  }

  /** Returns the objects of the map as recorded or, in the editing mode, after the edits. */
  shown() {
    const recorded = report.maps.length ? report.maps[this.map || 0].objects : report.objects;
    return this.editing && this.editing.on ? this.editing.edited.shown(recorded) : recorded;
  }

  /** Shows the current objects in the map, the table and the legend. */
  show() {
    if (this.viewer) this.viewer.setObjects(this.shown());
    if (this.table) this.table.show(this.shown());
    this.filter();
    if (byId("legend")) this.legend();
  }

  /** Selects an object, or clears the selection (null), in the map, the table and the panel. */
  choose(id, { fly = false } = {}) {
    if (this.editing && this.editing.on) return void this.editing.toggle(id);
    if (!this.objects.has(id) && this.objects.size) id = null;
    if (this.viewer && fly && id !== null) this.fly(id);
    this.select(id === null ? [] : [id], id, new Map(), !fly);
  }

  /** Marks objects as selected, labels objects in the map (texts by id), and shows the details of one object or null. */
  select(ids, detailed, labels, scroll) {
    if (this.viewer) {
      this.viewer.choose(ids);
      this.viewer.setLabels(labels);
    }
    if (this.table) this.table.choose(ids, scroll);
    this.panel(detailed);
  }

  /** Moves the camera to an object, and scrolls to the map if most of it is not visible. */
  fly(id) {
    this.viewer.flyTo(id);
    const { top, bottom, height } = byId("canvas").getBoundingClientRect();
    if (Math.min(bottom, innerHeight) - Math.max(top, 0) < height / 3) byId("map").scrollIntoView({ block: "start" });
  }

  panel(id) {
    const panel = byId("panel");
    if (!panel) return;
    panel.querySelector(".details")?.remove();
    const object = this.objects.get(id);
    const data = this.shown().find((one) => one.id === id);
    for (const one of panel.children) one.hidden = Boolean(object || data);
    if (object) panel.append(this.details(object, data));
    else if (data) panel.append(made("div", "details", made("h3", "", `${data.class} ${data.id}`), `confidence ${data.confidence.toFixed(2)}`));
  }

  details(object, { color, class: name }) {
    const close = made("button", "close", "×");
    close.setAttribute("aria-label", "Clear selection");
    close.addEventListener("click", () => (this.editing && this.editing.on ? this.editing.clear() : this.choose(null)));
    const parts = [close, made("h3", "", swatch(color), name, " ", made("span", "faint", String(object.id)))];
    const picture = this.table && this.table.picture(object.id);
    if (picture) {
      const copy = picture.cloneNode();
      copy.loading = "eager";
      parts.push(copy, made("p", "source", object.source === "map" ? "rendered from the map" : `from ${object.source}`));
    }
    const likely = object.probabilities.filter(([, share], k) => k < 2 || share >= 0.005);
    const bars = likely.flatMap(([name, share]) => [
      made("span", "", name), meter(share), made("span", "", share < 0.005 ? "<0.01" : share.toFixed(2)),
    ]);
    if (bars.length) parts.push(made("h4", "", "Class probabilities"), made("div", "bars", ...bars));
    const facts = [
      ...object.calibrated,
      ["Confidence", object.confidence.toFixed(2)],
      ["Size", object.size],
      ["Position", object.place],
      ["Height", object.height],
      ["Seen in", object.observations && `${object.observations} frames`],
      ["Frames", object.frames],
      ["Truth", object.truth],
    ];
    const shown = facts.filter(([, value]) => value);
    parts.push(made("h4", "", "Details"));
    parts.push(made("dl", "facts", ...shown.flatMap(([name, value]) => [made("dt", "", name), made("dd", "", value)])));
    return made("div", "details", ...parts);
  }

  legend() {
    const objects = this.shown().filter((one) => (one.owner || one.id) === one.id); // without objects merged into others
    const likely = objects.filter((one) => isLikely(one, this.confidence)).sort((a, b) => b.exists - a.exists);
    const classes = this.viewer && this.viewer.view === "class";
    const entries = classes ? [...new Map(likely.map((one) => [one.class, one])).values()] : likely;
    byId("legend").replaceChildren(...entries.map((one) => {
      const count = likely.filter((other) => other.class === one.class).length;
      const button = made("button", "", swatch(classes ? one.classColor : one.color), made("span", "", one.class),
        made("span", "", classes ? String(count) : one.exists.toFixed(2)));
      button.type = "button";
      button.addEventListener("click", () => this.choose(one.id, { fly: true }));
      return button;
    }));
  }
}

window.report = new Page();
