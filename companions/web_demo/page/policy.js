/** The networks that training writes: a contract in JSON, and tensors in the safetensors format. */

/** Tensors by name, as arrays on the file's memory. */
export function readTensors(buffer) {
  const headerBytes = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, headerBytes)));
  const tensors = {};
  for (const [name, { dtype, shape, data_offsets: offsets }] of Object.entries(header)) {
    if (name === "__metadata__") continue;
    if (dtype !== "F32") throw new Error(`tensor '${name}' is ${dtype}; the page reads F32`);
    const bytes = buffer.slice(8 + headerBytes + offsets[0], 8 + headerBytes + offsets[1]);
    tensors[name] = { shape, data: new Float32Array(bytes) };
  }
  return tensors;
}

export class Policy {
  /**
   * @param {object} contract of policy.json
   * @param {object} tensors of policy.safetensors, see `readTensors`
   * @param {number} inputClip standard deviations that inputs are clipped to
   */
  constructor(contract, tensors, inputClip) {
    this.contract = contract;
    this.tensors = tensors;
    this.inputClip = inputClip;
    this.numLayers = contract.hidden.length + 1;
  }

  /** Actions of an agent in [-1, 1], of its observation. */
  act(agent, observation) {
    const tensor = (name) => this.tensors[`agents.${agent}.${name}`].data;
    const [mean, std] = [tensor("input_mean"), tensor("input_std")];
    const clip = this.inputClip;
    let values = observation.map((value, i) => Math.min(Math.max((value - mean[i]) / std[i], -clip), clip));
    for (let layer = 0; layer < this.numLayers; layer++) {
      values = affine(tensor(`network.${2 * layer}.weight`), tensor(`network.${2 * layer}.bias`), values);
      if (layer < this.numLayers - 1) values = values.map((value) => (value > 0 ? value : Math.expm1(value)));
    }
    return Array.from(values, (value) => Math.min(Math.max(value, -1), 1));
  }
}

function affine(weight, bias, values) {
  const result = new Float64Array(bias.length);
  for (let row = 0; row < bias.length; row++) {
    let sum = bias[row];
    const start = row * values.length;
    for (let i = 0; i < values.length; i++) sum += weight[start + i] * values[i];
    result[row] = sum;
  }
  return result;
}
