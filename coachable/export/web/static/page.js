// What all pages share: messages, buttons, keys and links.

import { at, make, megabytes } from "./dom.js";

export class Page {
  resting = "Play"; // what the button says while the page is paused
  standing = ""; // what the banner says while there is nothing else to tell

  constructor(manifest) {
    this.manifest = manifest;
  }

  pause(paused) {
    this.paused = paused;
    at("pause").textContent = paused ? this.resting : "Pause";
  }

  tell(text, milliseconds = 0) {
    at("banner").textContent = text || this.standing;
    at("banner").hidden = !at("banner").textContent;
    clearTimeout(this.quiet);
    if (milliseconds) this.quiet = setTimeout(() => this.tell(""), milliseconds);
  }

  /** Say that there is no picture, as long as the page is open. */
  cannotDraw(error) {
    console.error(error);
    this.standing = "This browser cannot draw in 3-D; the measurements continue.";
    this.tell("");
  }

  /** List what the colours of the scene mean. */
  explain(legend) {
    at("legend-more").hidden = !legend.length;
    at("meanings").append(...legend.map(([colour, meaning]) => {
      const patch = make("i", {});
      patch.style.background = colour;
      return make("li", {}, patch, meaning);
    }));
  }

  /** Address of what is to be seen now. */
  get link() {
    return location.href;
  }

  /** Let buttons and keys act; a button without an action is not shown. */
  listen(actions) {
    const all = { pause: () => this.pause(!this.paused), share: () => this.#share(), ...actions };
    for (const id of ["pause", "push", "again", "share"]) {
      at(id).hidden = !(id in all);
      at(id).disabled = false;
      if (id in all) at(id).addEventListener("click", all[id]);
    }
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
      const typing = event.target.closest("button, summary, a, input[type=radio]");
      const id = { " ": typing ? undefined : "pause", p: "push", r: "again" }[event.key.toLowerCase()];
      if (id in all) {
        event.preventDefault();
        all[id]();
      }
    });
  }

  async #share() {
    try {
      await navigator.clipboard.writeText(this.link);
      at("share").textContent = "Copied";
    } catch {
      history.replaceState(null, "", this.link);
      at("share").textContent = "It is in the address bar";
    }
    setTimeout(() => (at("share").textContent = "Copy link"), 2000);
  }
}

/** Return the answer to a request of a file of the page. */
export async function fetched(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name}: ${answer.status} ${answer.statusText}`);
  return answer;
}

/**
 * Begin to load files, with a bar that shows how far it is.
 *
 * @param {string[]} names  The files.
 * @param {{file: string, bytes: number}[]} sizes  The manifest's downloads.
 * @returns {Map<string, Promise<Uint8Array>>} Content by name.
 */
export function download(names, sizes) {
  const total = sizes.filter(({ file }) => names.includes(file)).reduce((sum, { bytes }) => sum + bytes, 0);
  let loaded = 0;
  const read = async (name) => {
    const answer = await fetched(name);
    const chunks = [];
    for (const reader = answer.body.getReader(); ; ) {
      const { done, value } = await reader.read();
      if (done) break;
      chunks.push(value);
      loaded += value.length;
      if (at("loading-bar").hidden) continue; // the page could not start, and says why
      at("loading-bar").value = loaded / total;
      at("loading-text").textContent =
        loaded < total ? `Loading: ${megabytes(loaded)} of ${megabytes(total)}` : "Starting …";
    }
    return new Uint8Array(await new Blob(chunks).arrayBuffer());
  };
  return new Map(names.map((name) => [name, read(name)]));
}
