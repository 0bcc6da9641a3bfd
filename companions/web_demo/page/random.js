/** Draws from a seeded generator (32-bit multiply and xor-shift), so that a throw can be repeated. */
export class Random {
  /** @param {number} seed any number */
  constructor(seed) {
    this.state = seed >>> 0;
  }

  /** A number from the first up to the second limit. */
  uniform(lower = 0, upper = 1) {
    this.state = (this.state + 0x9e3779b9) >>> 0;
    let z = this.state;
    z = Math.imul(z ^ (z >>> 16), 0x85ebca6b);
    z = Math.imul(z ^ (z >>> 13), 0xc2b2ae35);
    return lower + (upper - lower) * (((z ^ (z >>> 16)) >>> 0) / 4294967296);
  }

  /** A whole number from the first to the last, both included. */
  integer(first, last) {
    return first + Math.floor(this.uniform() * (last - first + 1));
  }

  /** A draw from the normal distribution (Box and Muller). */
  normal() {
    const radius = Math.sqrt(-2 * Math.log(1 - this.uniform()));
    return radius * Math.cos(2 * Math.PI * this.uniform());
  }

  /** One of the entries. */
  choice(entries) {
    return entries[this.integer(0, entries.length - 1)];
  }
}
