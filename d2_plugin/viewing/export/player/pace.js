// How coarse images may be while something moves. A straight line through the last measurements tells what an image
// costs however small, which many Gaussians make large, and what a pixel costs, which is all that coarser ones save.
"use strict";

const QUICK = 1 / 15;  // seconds that an image may take
const COARSEST = 6;    // pixels of the screen per pixel of the image, each way
const KEPT = 0.85;     // what a measurement still weighs when the next one comes

class Pace {
  constructor() {
    this.sums = [0, 0, 0, 0, 0];
    this.fixed = 0;
    this.pixel = 0;
  }

  note(pixels, seconds) {
    [1, pixels, seconds, pixels * pixels, pixels * seconds].forEach((value, i) => {
      this.sums[i] = KEPT * this.sums[i] + value;
    });
    const [weight, ...rest] = this.sums, [x, y, xx, xy] = rest.map((sum) => sum / weight), spread = xx - x * x;
    if (spread > (0.2 * x) ** 2) {
      this.pixel = Math.max((xy - x * y) / spread, 0);
      this.fixed = Math.max(y - this.pixel * x, 0);
    } else {
      this.pixel = Math.max(y - this.fixed, 0) / x;
    }
  }

  // For an image that has `full` pixels at its finest; no sudden jumps from how coarse it was `before`.
  coarse(full, before) {
    const left = Math.max(QUICK - this.fixed, 0.5 * this.fixed), wanted = Math.sqrt((full * this.pixel) / left);
    return Math.min(Math.max(wanted, before / 1.25, 1), before * 2, COARSEST);
  }
}
