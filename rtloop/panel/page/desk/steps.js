// Steps of a jog: bounded by the stroke, so that no key and no click crosses it.

const LARGEST_PART = 10; // of the stroke, that a step is at most
const FIRST_PART = 50;
const COUNT = 10;
const ROUND = [1, 2, 5];

/** {sizes, first} for a stroke: round sizes in ascending order, the largest a tenth of the stroke at most. */
export function jogSteps(stroke) {
  const largest = stroke / LARGEST_PART;
  const sizes = [];
  for (let power = Math.floor(Math.log10(largest)); sizes.length < COUNT; power--) {
    for (const digit of ROUND.toReversed()) {
      const size = Number(`${digit}e${power}`);
      if (size <= largest * (1 + 1e-9) && sizes.length < COUNT) sizes.unshift(size);
    }
  }
  return { sizes, first: Number(`1e${Math.floor(Math.log10(stroke / FIRST_PART) + 1e-9)}`) };
}
