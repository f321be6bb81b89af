"use strict";

// Edits of the instances of a map, with the rules of `instancemap edit`. An edit is an entry of the file edits.json.

const LONGEST_CLASS_NAME = 100; // characters
const SPLITS = { parts: "into parts", plane: "by plane" };

/** The instances of a map after a list of edits. The result depends only on the arguments of the constructor. */
class EditedInstances {
  /** Applies `edits` in order to the recorded `objects` of the report. */
  constructor(objects, edits) {
    const editable = objects.filter((one) => one.vertices > 0);
    this.recorded = new Map(editable.map((one) => [one.id, one.class]));
    this.instances = new Map(editable.map(({ id, class: name }) => [id, {
      id,
      names: [name], // possible classes; the detections decide between several
      renamed: false,
      members: [id], // ids of the recorded objects, its own first
      splits: [],
    }]));
    this.owners = new Map(this.instances); // instance that contains each recorded object; without deleted objects
    for (const edit of edits) this.apply(edit);
  }

  apply(edit) {
    const [[operation, values]] = Object.entries(edit);
    if (operation === "merge") this.merge(...values);
    else if (operation === "split") this.instances.get(values[0]).splits.push(values[1]);
    else if (operation === "rename") Object.assign(this.instances.get(values[0]), { names: [values[1]], renamed: true });
    else values.forEach((id) => this.delete(id));
  }

  merge(id, ...merged) {
    const kept = this.instances.get(id);
    const all = [kept, ...merged.map((other) => this.instances.get(other))];
    const certain = all.filter((one) => one.renamed);
    kept.names = [...new Set((certain.length ? certain : all).flatMap((one) => one.names))];
    kept.renamed = certain.length > 0;
    kept.members = all.flatMap((one) => one.members);
    for (const member of kept.members) this.owners.set(member, kept);
    for (const other of merged) this.instances.delete(other);
  }

  delete(id) {
    for (const member of this.instances.get(id).members) this.owners.delete(member);
    this.instances.delete(id);
  }

  /** Returns the reason why an edit of instances is impossible, "" = possible. `name` is the class of a rename. */
  refusal(operation, ids, name = "") {
    if (operation === "merge" && ids.length < 2) return "Select two or more objects";
    if (!ids.length) return "Select an object";
    if (operation !== "merge" && operation !== "delete" && ids.length > 1) return "Select a single object";
    const unknown = ids.find((id) => !this.instances.has(id));
    if (unknown) return `Object ${unknown} has been merged or deleted`;
    if (operation === "rename" && !name) return "Enter a class name";
    if (/(?! )[\p{C}\p{Z}]/u.test(name)) return "Enter a name without control characters";
    if ([...name].length > LONGEST_CLASS_NAME) return `Enter at most ${LONGEST_CLASS_NAME} characters`;
    return "";
  }

  /** Returns the classes of an instance as text. */
  name(id) { return this.instances.get(id).names.join(" or "); }

  /** Returns the changes of a recorded object as text, "" = none. */
  changes(id) {
    if (!this.recorded.has(id)) return "";
    const owner = this.owners.get(id);
    if (!owner) return "deleted";
    if (owner.id !== id) return `merged into ${owner.id}`;
    const others = owner.members.filter((member) => member !== id);
    const before = this.recorded.get(id);
    return [
      owner.renamed && this.name(id) !== before && `was ${before}`,
      others.length && `merged with ${others.join(", ")}`,
      ...owner.splits.map((by) => `split ${SPLITS[by]}`),
    ].filter(Boolean).join("; ");
  }

  /** Returns the entries of the viewer, the table and the legend for `recorded` entries, after the edits. */
  shown(recorded) {
    const colors = new Map(recorded.map((one) => [one.id, one.color]));
    const classColors = new Map(recorded.map((one) => [one.class, one.classColor]));
    return recorded.map((one) => {
      const owner = this.owners.get(one.id);
      const note = this.changes(one.id);
      if (!owner) return { ...one, deleted: this.recorded.has(one.id), note };
      const color = colors.get(owner.id);
      return {
        ...one,
        owner: owner.id,
        class: this.name(owner.id),
        color,
        classColor: classColors.get(owner.names[0]) || color,
        edited: owner.renamed || owner.members.length > 1,
        note,
      };
    });
  }
}

/** Returns an edit as text. */
function editText(edit) {
  const [[operation, values]] = Object.entries(edit);
  const [id, argument] = values;
  if (operation === "merge") return `Merge ${values.slice(1).join(", ")} into ${id}`;
  if (operation === "split") return `Split ${id} ${SPLITS[argument]}`;
  if (operation === "rename") return `Rename ${id} to ${argument}`;
  return `Delete ${values.join(", ")}`;
}

/** Returns the content of edits.json: a JSON array with one edit per line. */
function editsFile(edits) {
  return `[\n${edits.map((edit) => `  ${JSON.stringify(edit)}`).join(",\n")}\n]\n`;
}
