// Small steps with elements of the page.

/** The element with an id. */
export const at = (id) => document.getElementById(id);

/** A new element. */
export function make(tag, attributes, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** A new shape in a picture. */
export function shape(tag, attributes, text = "") {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.textContent = text;
  return element;
}

/** An element that reacts to an event. */
export function listening(element, event, react) {
  element.addEventListener(event, react);
  return element;
}

/** Size of a file for people. */
export function megabytes(bytes) {
  return `${(bytes / 1e6).toFixed(1)} MB`;
}
