// How many pixels an image has while something moves, by what the last ones took.
"use strict";

const QUICK = 1 / 15;  // seconds that an image may take
const COARSEST = 6;    // pixels of the screen per pixel of the image, each way
const KEPT = 0.85;     // what a measurement still weighs when the next one comes

class Pace {
  constructor() {
    this.coarse = 2;
    this.sums = [0, 0, 0, 0, 0];
  }

  // A straight line through the measured times tells what an image costs however small, which many Gaussians make large,
  // and what a pixel costs, which is all that fewer pixels save: half of the fixed cost at least goes into pixels.
  note(pixels, seconds, [width, height]) {
    [1, pixels, seconds, pixels * pixels, pixels * seconds].forEach((value, i) => {
      this.sums[i] = KEPT * this.sums[i] + value;
    });
    const [x, y, xx, xy] = this.sums.slice(1).map((sum) => sum / this.sums[0]), spread = xx - x * x;
    const pixel = spread > (0.1 * x) ** 2 ? clamp((xy - x * y) / spread, [0, y / x]) : y / x, fixed = y - pixel * x;
    const wanted = Math.sqrt((width * height * pixel) / Math.max(QUICK - fixed, 0.5 * fixed));
    this.coarse = clamp(clamp(wanted, [this.coarse / 1.25, this.coarse * 1.5]), [1, COARSEST]);
  }
}
