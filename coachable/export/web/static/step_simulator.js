// The agent and its world, without a page: one ONNX graph is the policy, another one a control step of the simulation.
// It runs in a browser and in Node.

/**
 * Load the graphs.
 *
 * @param {object} parts
 * @param {object} parts.ort  The module of onnxruntime-web.
 * @param {object} parts.manifest  Content of manifest.json.
 * @param {Map<string, Uint8Array>} parts.files  Content of the manifest's `graphs` by file name.
 * @returns {Promise<StepSimulator>}
 */
export async function createStepSimulator({ ort, manifest, files }) {
  const sessions = ["policy", "step"].map((name) => ort.InferenceSession.create(files.get(manifest.graphs[name])));
  const [policy, graph] = await Promise.all(sessions);
  return new StepSimulator({ ort, manifest, policy, graph });
}

export class StepSimulator {
  constructor(parts) {
    Object.assign(this, parts);
    this.style = Float32Array.from(this.manifest.default_style);
    this.controls = new Float64Array(0);
    this.reset(0);
  }

  /** Start an episode in one of the manifest's initial states. */
  reset(index) {
    const start = this.manifest.starts[index % this.manifest.starts.length];
    this.restore(start.memory, start.observation);
    const { figures, gauges, camera } = start;
    this.seen = { figures: figures.flat(), gauges, camera, marks: [] };
    this.steps = 0;
  }

  /** Set the whole state. */
  restore(memory, observation) {
    this.memory = Float32Array.from(memory);
    this.observation = Float32Array.from(observation);
  }

  /** Return the policy's action in the present state. */
  async act() {
    const { action } = await this.policy.run({ observation: this.#row(this.observation), style: this.#row(this.style) });
    return action.data;
  }

  /** Advance by one control step under an action, and return what was measured. */
  async advance(action) {
    const result = await this.graph.run({
      memory: this.#row(this.memory),
      action: this.#row(action),
      style: this.#row(this.style),
    });
    const read = (name) => Array.from(result[name].data);
    this.restore(result.memory_after.data, result.observation.data);
    this.seen = { figures: read("figures"), marks: read("marks"), gauges: read("gauges"), camera: read("camera") };
    this.steps += 1;
    return { measured: read("measured"), mark: [NaN], terminated: Boolean(result.terminated.data[0]) };
  }

  /** Act and advance. */
  async step() {
    return this.advance(await this.act());
  }

  #row(values) {
    return new this.ort.Tensor("float32", Float32Array.from(values), [1, values.length]);
  }
}
