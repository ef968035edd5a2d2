// The coach's panel: requests as controls made from the declaration, and beside each what is measured.

import { listening, make, shape } from "./dom.js";
import { askedOf, fixed, isOutside, textOf, withUnit, words } from "./request.js";

export class Panel {
  /**
   * @param {HTMLFormElement} form  Receives the controls.
   * @param {HTMLElement} others  Receives the measures that belong to no request.
   * @param {object[]} entries  From `entriesOf`.
   * @param {object[]} measures  The manifest's measures.
   * @param {(name: string, value: number | string) => void} ask  Called when the visitor asks for something.
   * @param {string} note  A sentence below the controls, or "".
   */
  constructor(form, others, entries, measures, ask, note = "") {
    this.entries = entries.filter(({ idle }) => !idle);
    const names = new Set(this.entries.map(({ name }) => name));
    measures = measures.filter(({ text }) => text).map((measure) => (names.has(measure.parameter) ? measure : { ...measure, parameter: "" }));
    this.measures = measures;
    this.shown = new Map();
    for (const entry of this.entries) {
      const own = measures.filter((measure) => measure.parameter === entry.name);
      form.append(entry.options ? this.#choice(entry, own, ask) : this.#number(entry, own, ask));
    }
    if (note) form.append(make("p", { class: "small" }, note));
    for (const measure of measures.filter(({ parameter }) => !parameter)) {
      others.append(make("div", {}, make("dt", {}, `${words(measure.text)}:`), this.#value(measure, "dd")));
    }
  }

  /** Show what is asked for. */
  request(request) {
    for (const entry of this.entries) {
      const { inputs, asked, outside } = this.shown.get(`request ${entry.name}`);
      const value = request[entry.name];
      for (const input of inputs) {
        if (entry.options) input.checked = input.value === value;
        else {
          input.value = value;
          input.setAttribute("aria-valuetext", askedOf(entry, value));
        }
      }
      if (asked) asked.textContent = askedOf(entry, value);
      if (outside) outside.hidden = !isOutside(entry, value);
    }
    this.asked = request;
  }

  /** Show what was measured. */
  measured(readout) {
    for (const measure of this.measures) {
      const { value, pointer, meter, steps } = this.shown.get(`measure ${measure.name}`);
      const mean = readout.mean(measure.name);
      value.textContent = mean === null ? "…" : textOfMeasure(measure, mean);
      value.dataset.value = mean ?? "";
      if (meter) meter.style.width = `${100 * (mean ?? 0)}%`;
      if (pointer) {
        pointer.hidden = mean === null;
        if (mean !== null) pointer.style.setProperty("--at", placeOf(pointer.entry, mean));
      }
      if (!steps) continue;
      const last = readout.last(measure.name);
      drawSteps(steps, last, this.asked[measure.parameter], pointer?.entry.to ?? Math.max(1, ...last));
    }
  }

  /** Whether a pointer below a slider shows what was measured. */
  get points() {
    return [...this.shown.values()].some(({ pointer }) => pointer);
  }

  /** One sentence on each request with a measure, for a screen reader. */
  sentences(readout) {
    return this.measures
      .filter(({ parameter, name }) => parameter && readout.mean(name) !== null)
      .map((measure) => {
        const entry = this.entries.find(({ name }) => name === measure.parameter);
        const mean = textOfMeasure(measure, readout.mean(measure.name));
        return `${entry.label}: ${askedOf(entry, this.asked[entry.name])} requested, ${measure.text} ${mean}.`;
      })
      .join(" ");
  }

  #choice(entry, measures, ask) {
    const inputs = entry.options.map((value) =>
      listening(make("input", { type: "radio", name: entry.name, value }), "change", () => ask(entry.name, value)),
    );
    const options = inputs.map((input) => make("label", {}, input, make("span", {}, words(input.value))));
    this.shown.set(`request ${entry.name}`, { inputs });
    return make(
      "fieldset",
      { class: "request" },
      make("legend", {}, entry.label),
      make("p", { class: "help" }, entry.help),
      make("div", { class: "options" }, ...options),
      ...measures.flatMap((measure) => this.#line(measure)),
    );
  }

  #number(entry, measures, ask) {
    const id = `request-${entry.name}`;
    const attributes = { type: "range", id, name: entry.name, min: entry.from, max: entry.to, step: entry.step };
    const input = make("input", { ...attributes, "aria-describedby": `${id}-help` });
    listening(input, "input", () => ask(entry.name, Number(input.value)));
    const asked = make("output", { for: id, class: "asked", "aria-live": "off" });
    const slider = make("div", { class: entry.style ? "slider ranged" : "slider" }, input);
    const [low, high] = [placeOf(entry, entry.low), placeOf(entry, entry.high)];
    slider.style.setProperty("--low", entry.style ? low : "0%");
    slider.style.setProperty("--high", entry.style ? high : "0%");
    const outside = make("p", { class: "outside", hidden: "" }, "Outside of the trained range: the agent has never been asked for this.");
    const lines = measures.flatMap((measure) => {
      if (!measure.comparable) return this.#line(measure);
      const pointer = make("div", { class: "pointer", hidden: "" });
      pointer.entry = entry;
      slider.append(pointer);
      return this.#line(measure, pointer);
    });
    if (entry.style) {
      for (const value of [entry.low, entry.high]) {
        const end = make("span", { class: "ends", "aria-hidden": "true" }, textOf(entry, value));
        end.style.left = placeOf(entry, value);
        slider.append(end);
      }
    }
    this.shown.set(`request ${entry.name}`, { inputs: [input], asked, outside });
    const range = entry.style ? `; trained from ${textOf(entry, entry.low)} to ${textOf(entry, entry.high)}` : "";
    const heading = make("label", { class: "name", for: id }, entry.label);
    const help = make("p", { class: "help", id: `${id}-help` }, entry.help, make("span", { class: "unseen" }, range));
    const top = make("div", { class: "row" }, heading, asked);
    return make("div", { class: "request" }, top, help, slider, outside, ...lines);
  }

  /** A measure below its request. */
  #line(measure, pointer) {
    const value = this.#value(measure, "output");
    const shown = this.shown.get(`measure ${measure.name}`);
    shown.pointer = pointer;
    const parts = [make("div", { class: "row" }, make("span", { class: "help" }, words(measure.text)), value)];
    if (measure.share) {
      shown.meter = make("div", {});
      parts.push(make("div", { class: "meter", "aria-hidden": "true" }, shown.meter));
    }
    if (measure.at_marks) {
      shown.steps = shape("svg", { class: "steps", "aria-hidden": "true" });
      parts.push(shown.steps);
    }
    return parts;
  }

  #value(measure, tag) {
    const value = make(tag, { class: "found", id: `measured-${measure.name}`, "aria-live": "off" }, "…");
    this.shown.set(`measure ${measure.name}`, { value });
    return value;
  }
}

/** Bars of the last values, with a line at the request. */
function drawSteps(svg, values, asked, top) {
  const signature = `${values.join()} ${asked} ${svg.clientWidth}`;
  if (svg.dataset.signature === signature) return;
  svg.dataset.signature = signature;
  const [width, height, foot] = [svg.clientWidth || 300, 84, 16];
  const scale = (height - foot - 4) / top;
  const column = width / 8;
  const bars = values.flatMap((value, i) => {
    const size = Math.max(value, 0) * scale;
    const x = i * column;
    return [
      shape("rect", { x: x + 5, y: height - foot - size, width: column - 10, height: size, rx: 3, opacity: 0.45 + 0.55 * ((i + 1) / values.length) }),
      shape("text", { x: x + column / 2, y: height - 3 }, fixed(value, 2)),
    ];
  });
  const y = height - foot - asked * scale;
  svg.replaceChildren(...bars, shape("line", { x1: 0, x2: width, y1: y, y2: y }));
}

/** Where a value lies below a slider, whose thumb does not go quite to the ends. */
function placeOf({ from, to }, value) {
  const share = Math.min(Math.max((value - from) / (to - from), 0), 1);
  return `calc(12px + ${share.toFixed(4)} * (100% - 24px))`;
}

function textOfMeasure({ share, unit, circular, digits }, value) {
  if (circular) return withUnit(String(Math.round(value) || 0), unit);
  return share ? `${Math.round(100 * value)} % of the time` : withUnit(fixed(value, digits), unit);
}
