// Recorded episodes and backdrops, as `coachable.scene.recorded` writes them. It runs in a browser and in Node.

const KINDS = { float32: Float32Array, uint32: Uint32Array, uint16: Uint16Array, int16: Int16Array, uint8: Uint8Array };

/**
 * Decode a file.
 *
 * @param {Uint8Array} bytes  Its content; a server may have decompressed it already.
 * @returns {Promise<object>} The header, with the arrays by name in `arrays`.
 */
export async function decode(bytes) {
  const plain = bytes[0] === 0x1f && bytes[1] === 0x8b ? await decompressed(bytes) : bytes.slice().buffer;
  const length = new DataView(plain).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(plain, 4, length)));
  const arrays = new Map(
    header.arrays.map(({ name, type, shape, offset }) => {
      const count = shape.reduce((product, size) => product * size, 1);
      return [name, new KINDS[type](plain, 4 + length + offset, count)];
    }),
  );
  return { ...header, arrays };
}

async function decompressed(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** The parameters whose values differ between recordings. */
export function varied({ parameters }) {
  return parameters.filter(({ values }) => values.length > 1);
}

/** Number of the recording that is most like a style, of those that have the same value of the parameter `name`. */
export function nearest(manifest, style, name = null) {
  const apart = ({ name: parameter, kind, values }, recorded) => {
    if (kind === "choice") return Number(recorded[parameter] !== style[parameter]);
    return Math.abs(recorded[parameter] - style[parameter]) / (values.at(-1) - values[0]);
  };
  let best = { number: 0, distance: Infinity };
  manifest.recordings.forEach(({ style: recorded }, number) => {
    const fits = name === null || recorded[name] === style[name];
    const distance = fits ? varied(manifest).reduce((sum, parameter) => sum + apart(parameter, recorded), 0) : Infinity;
    if (distance < best.distance) best = { number, distance };
  });
  return best.number;
}

/** Numbers of the recordings in which all but one parameter are as in a style, by that one's value. */
export function along(manifest, style, name) {
  const others = varied(manifest).filter((parameter) => parameter.name !== name);
  const values = manifest.parameters.find((parameter) => parameter.name === name).values;
  const find = (value) =>
    manifest.recordings.findIndex(
      ({ style: recorded }) => recorded[name] === value && others.every(({ name: other }) => recorded[other] === style[other]),
    );
  return values.map((value) => [value, find(value)]).filter(([, number]) => number >= 0);
}

/** The recording that is most like what the fragment of an address names, and the moment in it [s], null if it names none. */
export function fromFragment(manifest, fragment) {
  const given = new URLSearchParams(fragment.replace(/^#/, ""));
  const style = { ...manifest.recordings[manifest.opens ?? 0].style };
  for (const { name, kind, values } of varied(manifest)) {
    const text = given.get(name)?.trim();
    if (kind === "choice" ? values.includes(text) : text && Number.isFinite(Number(text))) {
      style[name] = kind === "choice" ? text : Number(text);
    }
  }
  const moment = given.get("t")?.trim();
  return { number: nearest(manifest, style), moment: moment && Number.isFinite(Number(moment)) ? Math.max(Number(moment), 0) : null };
}

/** The fragment of an address that names a recording, and a moment in it [s] if one is given. */
export function fragmentOf(manifest, number, moment = null) {
  const { style } = manifest.recordings[number];
  const pairs = varied(manifest).map(({ name }) => [name, style[name]]);
  return `#${new URLSearchParams(moment === null ? pairs : [...pairs, ["t", moment.toFixed(1)]])}`;
}
