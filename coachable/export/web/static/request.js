// What is asked of the agent: values of the declared parameters and controls, as theta, as text and as a link.

const MARGIN = 0.2; // share of the trained range by which a slider exceeds it to either side

/** One entry per parameter and control, in the order of the declaration. */
export function entriesOf(manifest) {
  const idle = new Set(manifest.idle);
  const styles = manifest.style_space.parameters.map((parameter) => ({ default: 0, ...parameter, style: true, idle: idle.has(parameter.name) }));
  const controls = manifest.controls.map((control) => ({ ...control, kind: "control" }));
  return [...styles, ...controls].map((entry) => ({ ...entry, label: words(manifest.names?.[entry.name] ?? entry.name), ...sliderOf(entry) }));
}

/** Range and step of an entry's slider. A control has no trained range of its own. */
function sliderOf({ kind, low, high }) {
  if (kind === "choice") return {};
  const width = high - low;
  const step = 10 ** Math.floor(Math.log10(width) - 1.3);
  if (kind === "control") return { from: low, to: high, step };
  const fit = (value) => Math.round(value / step) * step;
  const from = fit(low - MARGIN * width);
  return { from: low < 0 ? from : Math.max(from, low > 0 ? step : 0), to: fit(high + MARGIN * width), step };
}

/** Every entry's default by name. */
export function defaultsOf(entries) {
  return Object.fromEntries(entries.map(({ name, default: value }) => [name, value]));
}

/** The value of a control some time [s] later, while it approaches another one at its rate on the shorter way. */
export function approach({ low, high, circular, rate }, present, wanted, seconds) {
  const turn = high - low;
  const apart = wanted - present - (circular ? turn * Math.round((wanted - present) / turn) : 0);
  if (rate === null || Math.abs(apart) <= rate * seconds) return wanted;
  const next = present + Math.sign(apart) * rate * seconds;
  return circular ? next - turn * Math.floor((next - low) / turn) : next;
}

/** Theta of a request: options as one-hot vectors, and numbers as they are. */
export function thetaOf(entries, request) {
  return entries
    .filter(({ style }) => style)
    .flatMap(({ kind, name, options }) =>
      kind === "choice" ? options.map((option) => Number(option === request[name])) : [request[name]],
    );
}

/** Values of the controls of a request. */
export function controlsOf(entries, request) {
  return entries.filter(({ kind }) => kind === "control").map(({ name }) => request[name]);
}

/** Whether a request lies outside of the range in which the agent was trained. */
export function isOutside({ kind, low, high, style }, value) {
  return Boolean(style) && kind !== "choice" && (value < low - 1e-9 || value > high + 1e-9);
}

/** The fragment of an address that describes a request. */
export function fragmentOf(entries, request) {
  const pairs = entries.map((entry) => [entry.name, entry.options ? request[entry.name] : plain(entry, request[entry.name])]);
  return `#${new URLSearchParams(pairs)}`;
}

/** The request that a fragment describes; what it does not name or what makes no sense is taken from `request`. */
export function fromFragment(entries, fragment, request) {
  const given = new URLSearchParams(fragment.replace(/^#/, ""));
  const result = { ...request };
  for (const entry of entries) {
    const text = given.get(entry.name);
    if (text === null || text.trim() === "") continue;
    if (entry.options) {
      if (entry.options.includes(text)) result[entry.name] = text;
    } else if (Number.isFinite(Number(text))) {
      const steps = Math.round((Number(text) - entry.from) / entry.step); // a slider has no values between its steps
      const value = Number((entry.from + steps * entry.step).toPrecision(9));
      result[entry.name] = Math.min(Math.max(value, entry.from), entry.to);
    }
  }
  return result;
}

/** A value as text, with the digits of the slider's step, and its unit. */
export function textOf(entry, value) {
  return entry.options ? words(value) : withUnit(plain(entry, value), entry.unit);
}

/** A requested value as text; a weight has no unit and says what it is. */
export function askedOf(entry, value) {
  return entry.kind === "weight" ? `weight ${textOf(entry, value)}` : textOf(entry, value);
}

/** A number with some digits after the point, and zero without a sign. */
export function fixed(value, digits) {
  return Number(value).toFixed(digits).replace(/^-(0(\.0*)?)$/, "$1");
}

/** A number with its unit. */
export function withUnit(number, unit) {
  return unit === "deg" ? `${number}°` : unit ? `${number} ${unit}` : number;
}

/** A name as words. */
export function words(name) {
  const text = name.replaceAll("_", " ");
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function plain({ step }, value) {
  const digits = Math.max(0, -Math.floor(Math.log10(step)));
  return fixed(value, digits);
}
