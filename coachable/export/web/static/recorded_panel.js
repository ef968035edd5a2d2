// The coach's panel of recordings: sliders that snap to the recorded values, and beside each what was measured.

import { listening, make, shape } from "./dom.js";
import { along, varied } from "./recording.js";
import { fixed, withUnit, words } from "./request.js";

const SLIDERS = 2; // beyond this number of parameters, whole styles are chosen

export class RecordedPanel {
  /**
   * @param {HTMLFormElement} form  Receives the controls.
   * @param {HTMLElement} others  Receives the measures that belong to no request.
   * @param {object} manifest  The page's manifest.
   * @param {(name: string | null, value: number | string) => void} ask  Called with a parameter and its value, or with
   *   null and the number of a recording.
   */
  constructor(form, others, manifest, ask) {
    this.manifest = manifest;
    for (const measure of manifest.measures) {
      const found = manifest.recordings.map(({ measured }) => measured[measure.name]);
      measure.answer = measure.share && measure.digits === 0 && found.every((value) => value === 0 || value === 1);
    }
    this.show = []; // functions that show a recording
    const parameters = varied(manifest);
    const fixed = manifest.parameters.filter(({ values }) => values.length === 1);
    const beside = new Set();
    if (parameters.length > SLIDERS) form.append(this.#styles(ask));
    else {
      for (const parameter of parameters) {
        const own = manifest.measures.filter((measure) => measure.parameter === parameter.name);
        own.forEach(({ name }) => beside.add(name));
        form.append(parameter.kind === "choice" ? this.#choice(parameter, own, ask) : this.#slider(parameter, own, ask));
      }
      const told = fixed.filter(({ values }) => values[0] !== 0).map((p) => `${p.text} ${textOf(p, p.values[0])}`);
      if (told.length) form.append(make("p", { class: "small" }, `Requested in all recordings: ${told.join(", ")}.`));
    }
    for (const measure of manifest.measures.filter(({ name }) => !beside.has(name))) {
      const line = make("div", {}, make("dt", {}, `${words(measure.text)}:`), this.#value(measure, "dd"));
      this.show.push(({ measured }) => (line.hidden = measured[measure.name] === null));
      others.append(line);
    }
  }

  /** Show what is requested and was measured in a recording. */
  select(number) {
    const recording = this.manifest.recordings[number];
    for (const show of this.show) show(recording, number);
  }

  /** What is requested and was measured in a recording, for a screen reader. */
  sentences(number) {
    const { style, measured } = this.manifest.recordings[number];
    const parameters = varied(this.manifest);
    const requested = parameters.length > SLIDERS ? this.labels[number] : parameters.map((p) => `${words(p.text)} ${textOf(p, style[p.name])}`).join(", ");
    const known = this.manifest.measures.filter(({ name }) => measured[name] !== null);
    const found = known.map((measure) => `${measure.text} ${textOfMeasure(measure, measured[measure.name])}`);
    return `Requested: ${requested}. Measured in the recording: ${found.join(", ")}.`;
  }

  #slider(parameter, measures, ask) {
    const { name, values, help } = parameter;
    const id = `request-${name}`;
    const attributes = { type: "range", id, name, min: 0, max: values.length - 1, step: 1, "aria-describedby": `${id}-help` };
    const input = listening(make("input", attributes), "input", () => ask(name, values[Number(input.value)]));
    const asked = make("output", { for: id, class: "asked", "aria-live": "off" });
    const ticks = values.map((value, i) => {
      const tick = make("span", { class: "tick", "aria-hidden": "true" }, plain(value));
      tick.style.left = `calc(12px + ${i / (values.length - 1)} * (100% - 24px))`;
      return tick;
    });
    this.show.push(({ style }) => {
      input.value = values.indexOf(style[name]);
      asked.textContent = `${parameter.weight ? "weight " : ""}${textOf(parameter, style[name])}`;
      input.setAttribute("aria-valuetext", asked.textContent);
    });
    const top = make("div", { class: "row" }, make("label", { class: "name", for: id }, words(parameter.text)), asked);
    const text = make("p", { class: "help", id: `${id}-help` }, sentence(help));
    const slider = make("div", { class: "slider ranged recorded" }, input, ...ticks);
    return make("div", { class: "request" }, top, text, slider, ...measures.flatMap((m) => this.#bars(m, parameter)));
  }

  #choice(parameter, measures, ask) {
    const { name, values, help } = parameter;
    const options = this.#options(name, values.map((value) => words(value)), (i) => ask(name, values[i]), ({ style }) => values.indexOf(style[name]));
    const legend = make("legend", {}, words(parameter.text));
    const lines = measures.flatMap((measure) => this.#bars(measure, parameter));
    return make("fieldset", { class: "request" }, legend, make("p", { class: "help" }, sentence(help)), options, ...lines);
  }

  /** Buttons for whole styles, each named after what it asks for beyond the first one. */
  #styles(ask) {
    const { recordings, parameters } = this.manifest;
    const neutral = recordings[0].style;
    this.labels = recordings.map(({ style }) => {
      const asked = parameters.filter(({ name }) => style[name] !== neutral[name]);
      return asked.map((p) => styleText(p, style[p.name])).join(", ") || "No request";
    });
    const help = make("p", { class: "help", "aria-live": "off" });
    this.show.push(({ style }) => {
      const asked = parameters.filter(({ name }) => style[name] !== neutral[name]);
      help.textContent = asked.map((p) => `${sentence(p.help)} Weight ${textOf(p, style[p.name])}.`).join(" ") || "The agent does as it likes.";
    });
    const options = this.#options("style", this.labels, (number) => ask(null, number), (_, number) => number);
    return make("fieldset", { class: "request" }, make("legend", {}, "Style"), options, help);
  }

  #options(name, texts, choose, chosen) {
    const inputs = texts.map((_, i) => listening(make("input", { type: "radio", name, value: i }), "change", () => choose(i)));
    this.show.push((recording, number) => inputs.forEach((input, i) => (input.checked = i === chosen(recording, number))));
    return make("div", { class: "options" }, ...inputs.map((input, i) => make("label", {}, input, make("span", {}, texts[i]))));
  }

  /** A measure below its request, with bars for all recorded values of the request. */
  #bars(measure, parameter) {
    const { name } = parameter;
    const top = make("div", { class: "row" }, make("span", { class: "help" }, words(measure.text)), this.#value(measure, "output"));
    const bars = shape("svg", { class: "steps recorded", "aria-hidden": "true" });
    const asked = measure.asked ? parameter.values : [];
    this.show.push(({ style }) => {
      const rows = along(this.manifest, style, name).map(([value, number]) => [value, this.manifest.recordings[number].measured[measure.name]]);
      const known = rows.map(([, found]) => found).filter((value) => value !== null);
      const [low, high] = [Math.min(0, ...known), Math.max(1e-9, ...known, ...asked)];
      const [width, height, foot, head] = [bars.clientWidth || 300, 84, 6, 14];
      const column = (width - 24) / Math.max(parameter.values.length - 1, 1);
      const up = (value) => head + ((high - value) / (high - low)) * (height - foot - head);
      const shapes = rows.flatMap(([value, found]) => {
        const at = parameter.values.indexOf(value);
        const x = 12 + at * column; // below the slider's own mark
        const half = Math.min(0.36 * column, 10);
        const anchor = { 0: "start", [parameter.values.length - 1]: "end" }[at] ?? "middle";
        const here = value === style[name] ? "here" : "";
        const drawn = [];
        if (found !== null) {
          const [y, size] = [Math.min(up(found), up(0)), Math.abs(up(found) - up(0))];
          drawn.push(shape("rect", { class: here, x: x - half, y, width: 2 * half, height: Math.max(size, 1), rx: 3 }));
        }
        const text = found === null ? "–" : shortOf(measure, found);
        const shift = anchor === "start" ? -half : anchor === "end" ? half : 0;
        drawn.push(shape("text", { class: `${here} ${anchor}`, x: x + shift, y: (found === null ? up(0) : Math.min(up(found), up(0))) - 4 }, text));
        if (asked.length) drawn.push(shape("line", { x1: x - half - 2, x2: x + half + 2, y1: up(value), y2: up(value) }));
        return drawn;
      });
      bars.replaceChildren(...shapes);
    });
    return [top, bars];
  }

  #value(measure, tag) {
    const value = make(tag, { class: "found", id: `measured-${measure.name}`, "aria-live": "off" });
    this.show.push(({ measured }) => {
      value.textContent = textOfMeasure(measure, measured[measure.name]);
      value.dataset.value = measured[measure.name] ?? "";
    });
    return value;
  }
}

/** What a whole style asks for by one weight. */
function styleText(parameter, value) {
  const { text, kind, values } = parameter;
  if (kind === "choice") return `${words(text)} ${textOf(parameter, value)}`;
  if (value < 0 && values.filter((other) => other < 0).length === 1) return `Avoid ${text}`;
  return value > 0 && values.filter((other) => other > 0).length === 1 ? words(text) : `${words(text)} ${textOf(parameter, value)}`;
}

function textOf({ kind, unit }, value) {
  return kind === "choice" ? words(value) : withUnit(plain(value), unit);
}

function textOfMeasure(measure, value) {
  if (value === null) return "–";
  if (measure.answer) return value ? "yes" : "no";
  return measure.share ? shortOf(measure, value) : withUnit(shortOf(measure, value), measure.unit);
}

function shortOf({ share, significant, digits }, value) {
  if (share) return `${(100 * value).toFixed(digits === 3 ? 0 : digits)} %`;
  return significant ? plain(Number(value.toPrecision(digits))) : fixed(value, digits);
}

/** A number without needless digits, which do not come from the request. */
function plain(value) {
  return String(Number(value.toPrecision(4)));
}

function sentence(text) {
  return text && `${text.charAt(0).toUpperCase()}${text.slice(1)}${text.endsWith(".") ? "" : "."}`;
}
