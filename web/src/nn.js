// The policy's network and its normaliser: twins of nn.RunningNorm.normalise, nn.MLP.__call__ and Policy.mean_action.

const ACTIVATIONS = {
  leaky_relu: (x, slope) => Math.max(x, slope * x),
  tanh: (x) => Math.tanh(x),
};

export class Policy { // policy.Policy, the actor alone
  constructor(shape, arrays) {
    if (!ACTIVATIONS[shape.activation]) throw new Error(`unknown activation ${shape.activation}`);
    this.shape = shape;
    this.mean = arrays.norm_mean;
    this.invStd = arrays.norm_inv_std;
    this.layers = [];
    let start = 0;
    for (let i = 0; i + 1 < shape.sizes.length; i++) {
      const [n, m] = [shape.sizes[i], shape.sizes[i + 1]];
      const w = new Float32Array(n * m); // one row a unit, so that the inner loop walks through memory in order
      for (let r = 0; r < n; r++) for (let c = 0; c < m; c++) w[c * n + r] = arrays.theta[start + r * m + c];
      start += n * m;
      this.layers.push({ n, m, w, b: arrays.theta.slice(start, start + m), out: new Float32Array(m) });
      start += m;
    }
    if (start !== arrays.theta.length) throw new Error(`${arrays.theta.length} weights, expected ${start}`);
    this.x = new Float32Array(shape.sizes[0]);
  }

  meanAction(obs) { // policy.Policy.mean_action: without noise
    const { clip, activation, slope } = this.shape;
    const act = ACTIVATIONS[activation];
    for (let i = 0; i < this.x.length; i++) {
      const value = Math.fround(obs[i] - this.mean[i]) * this.invStd[i];
      this.x[i] = Math.min(Math.max(value, -clip), clip);
    }
    let h = this.x;
    this.layers.forEach(({ n, m, w, b, out }, k) => {
      const last = k + 1 === this.layers.length;
      for (let c = 0, at = 0; c < m; c++, at += n) {
        let sum = 0;
        for (let r = 0; r < n; r++) sum += h[r] * w[at + r];
        sum += b[c];
        out[c] = last ? sum : act(sum, slope);
      }
      h = out;
    });
    return h;
  }
}
