// What was measured since the latest request, over the last seconds and over the last marks on the ground.

const MARKS = 8; // of which values are kept

export class Readout {
  /**
   * @param {object[]} measures  The manifest's measures.
   * @param {number} seconds  Time over which shares and means are taken [s].
   */
  constructor(measures, seconds) {
    this.measures = measures;
    this.seconds = seconds;
    this.clear();
  }

  /** Forget everything: a request or an episode begins. */
  clear() {
    this.rows = [];
    this.marked = new Map(this.measures.map(({ name }) => [name, []]));
  }

  /** Add what was measured at a time [s]; NaN is not a value. */
  add(time, values) {
    this.rows.push({ time, values });
    while (this.rows[0].time < time - this.seconds) this.rows.shift();
    this.measures.forEach(({ name, at_marks }, i) => {
      if (!at_marks || Number.isNaN(values[i])) return;
      const kept = this.marked.get(name);
      kept.push(values[i]);
      if (kept.length > MARKS) kept.shift();
    });
  }

  /** The last values of a measure that is taken at marks. */
  last(name) {
    return this.marked.get(name);
  }

  /** Mean of a measure, divided by that of another one if it is measured per another one, or null if there is no value. */
  mean(name) {
    const index = this.measures.findIndex((measure) => measure.name === name);
    const { at_marks, circular, per } = this.measures[index];
    if (per) {
      const [own, other] = [index, this.measures.findIndex((measure) => measure.name === per)].map((i) =>
        this.rows.reduce((sum, { values }) => sum + values[i], 0),
      );
      return other > 0 ? own / other : null;
    }
    const values = at_marks ? this.last(name) : this.rows.map((row) => row.values[index]);
    const known = values.filter((value) => !Number.isNaN(value));
    if (circular && known.length) {
      const sum = (part) => known.reduce((total, value) => total + part((value * Math.PI) / 180), 0);
      return (Math.atan2(sum(Math.sin), sum(Math.cos)) * 180) / Math.PI;
    }
    return known.length ? known.reduce((sum, value) => sum + value, 0) / known.length : null;
  }
}
