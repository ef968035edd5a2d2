// Gauges and the small map beside a scene.

import { at, make, shape } from "./dom.js";
import { fixed } from "./request.js";

/** Show gauges: a name, a text, the share of a bar or null, and its colour each. */
export function showGauges(gauges) {
  const box = at("gauges");
  if (box.children.length !== gauges.length) {
    box.replaceChildren(...gauges.map(() => make("div", {}, make("b", {}), make("span", {}, make("i", {}), make("em", {})))));
  }
  gauges.forEach(([name, text, share, colour], i) => {
    const [title, value] = box.children[i].children;
    const [bar, words] = value.children;
    if (title.textContent !== name) title.textContent = name;
    words.textContent = text;
    bar.hidden = share === null;
    bar.style.width = `${100 * Math.min(Math.max(share ?? 0, 0), 1)}%`;
    bar.style.background = colour;
  });
}

/** Make a gauge from numbers by name, as `coachable.scene.gauge_form.GaugeForm` does. */
export function gaugeOf({ name, text, shown, full, colour, alert, alert_text, alert_colour }, values) {
  const unusual = alert !== "" && values[alert] > 0.5;
  const words = text.replace(/\{(\w+):\.(\d+)f\}/g, (_, key, digits) => fixed(values[key], digits));
  return [name, words + (unusual ? alert_text : ""), values[shown] / full, unusual ? alert_colour : colour];
}

/** Draw the outline of the map, and a dot of each colour, the agent's first. */
export function drawMap(outline, colours) {
  const points = outline.map((point) => point.join()).join(" ");
  const dots = colours.map((fill) => shape("circle", { r: 4, fill }));
  at("map").replaceChildren(shape("polygon", { points }), ...dots.reverse());
}

/** Move the dots of the map to places, of which x is NaN if there is none. */
export function moveDots(places) {
  const dots = [...at("map").children].slice(1).reverse();
  dots.forEach((dot, i) => {
    const [x, y] = places.slice(2 * i, 2 * i + 2);
    dot.toggleAttribute("hidden", Number.isNaN(x));
    if (!Number.isNaN(x)) dot.setAttribute("transform", `translate(${x} ${y})`);
  });
}
