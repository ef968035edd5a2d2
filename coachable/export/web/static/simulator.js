// The agent and its world, without a page: MuJoCo steps, and ONNX graphs turn its state into observations and actions.
// It runs in a browser and in Node.

/**
 * Load the models and the graphs, each as soon as its engine and its file are here.
 *
 * @param {object} parts
 * @param {object | Promise} parts.mujoco  The loaded module of @mujoco/mujoco.
 * @param {object | Promise} parts.ort  The module of onnxruntime-web.
 * @param {object} parts.manifest  Content of manifest.json.
 * @param {Map<string, Uint8Array | Promise>} parts.files  Content of the manifest's `models` and `graphs` by file name.
 * @returns {Promise<Simulator>}
 */
export async function createSimulator({ mujoco, ort, manifest, files }) {
  const session = async (name, options) => {
    const graph = await files.get(manifest.graphs[name]);
    return (await ort).InferenceSession.create(graph, options);
  };
  const state = async (name) => {
    const xml = new TextDecoder().decode(await files.get(manifest.models[name]));
    const { MjModel, MjData } = await mujoco;
    const model = MjModel.from_xml_string(xml);
    return { model, data: new MjData(model) };
  };
  const [policy, features, dynamics, kinematics] = await Promise.all([
    session("policy"),
    session("features", { graphOptimizationLevel: "disabled" }), // hundreds of small operators: there is little to gain
    state("dynamics"),
    state("kinematics"),
  ]);
  return new Simulator({ mujoco: await mujoco, ort: await ort, manifest, dynamics, kinematics, policy, features });
}

export class Simulator {
  constructor(parts) {
    Object.assign(this, parts);
    this.style = Float32Array.from(this.manifest.default_style);
    this.controls = Float64Array.from(this.manifest.controls, (control) => control.default);
    this.reset(0);
  }

  /** Start an episode in one of the manifest's initial states. */
  reset(index) {
    const start = this.manifest.starts[index % this.manifest.starts.length];
    this.restore(start.positions, new Float64Array(this.dynamics.model.nv), start.memory, start.observation);
    this.steps = 0;
    this.pushed = { force: [0, 0, 0], left: 0 };
  }

  /** Set the whole state. */
  restore(positions, velocities, memory, observation) {
    const { mujoco, dynamics, kinematics } = this;
    mujoco.mj_resetData(dynamics.model, dynamics.data); // forgets what the solver starts from
    for (const { data } of [dynamics, kinematics]) {
      data.qpos.set(positions);
      data.qvel.set(velocities);
    }
    mujoco.mj_forward(kinematics.model, kinematics.data); // for the picture
    this.memory = Float64Array.from(memory);
    this.observation = Float32Array.from(observation);
  }

  /** Push the body along a direction in the ground plane [rad] for the manifest's duration. */
  push(direction) {
    const { force, duration } = this.manifest.push;
    const left = Math.round(duration / this.manifest.physics.control_step);
    this.pushed = { force: [force * Math.cos(direction), force * Math.sin(direction), 0], left };
  }

  /** Return the policy's action in the present state. */
  async act() {
    const { action } = await this.policy.run({
      observation: new this.ort.Tensor("float32", this.observation, [1, this.observation.length]),
      style: new this.ort.Tensor("float32", this.style, [1, this.style.length]),
    });
    return action.data;
  }

  /** Advance the physics by one control step. */
  advance(action) {
    const { mujoco, dynamics } = this;
    dynamics.data.ctrl.set(action);
    dynamics.data.qfrc_applied.set(this.pushed.left > 0 ? this.pushed.force : [0, 0, 0]);
    this.pushed.left = Math.max(this.pushed.left - 1, 0);
    for (let i = 0; i < this.manifest.physics.substeps; i++) mujoco.mj_step(dynamics.model, dynamics.data);
    this.steps += 1;
  }

  /** Read the geometry of the present state. */
  sense() {
    const { mujoco, dynamics, kinematics } = this;
    kinematics.data.qpos.set(dynamics.data.qpos);
    kinematics.data.qvel.set(dynamics.data.qvel);
    mujoco.mj_forward(kinematics.model, kinematics.data);
    return Float64Array.from(kinematics.data.sensordata);
  }

  /** Update observation and memory from the state and its sensors, and return what was measured. */
  async observe(positions, velocities, sensors) {
    const row = (values) => new this.ort.Tensor("float64", Float64Array.from(values), [1, values.length]);
    const result = await this.features.run({
      positions: row(positions),
      velocities: row(velocities),
      sensors: row(sensors),
      controls: row(this.controls),
      style: new this.ort.Tensor("float32", this.style, [1, this.style.length]),
      memory: row(this.memory),
    });
    this.memory = Float64Array.from(result.memory_after.data);
    this.observation = Float32Array.from(result.observation.data);
    return {
      measured: Array.from(result.measured.data),
      mark: Array.from(result.mark.data),
      terminated: Boolean(result.terminated.data[0]),
    };
  }

  /** Act, advance and observe. A state that is not finite counts as terminated. */
  async step() {
    this.advance(await this.act());
    const { qpos, qvel } = this.dynamics.data;
    if (!qpos.every(Number.isFinite) || !qvel.every(Number.isFinite)) {
      return { measured: this.manifest.measures.map(() => NaN), mark: [NaN], terminated: true };
    }
    const sensors = this.sense();
    return this.observe(this.dynamics.data.qpos, this.dynamics.data.qvel, sensors);
  }
}
