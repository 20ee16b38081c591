// Figures of a trace between two times, computed from its envelope.

/** {low, high, mean, rms, deviation, exact} of the points of a sweep between two times in s. */
export function measure(sweep, name, from_s, to_s) {
  const low = sweep.arrays[`${name}:low`];
  const high = sweep.arrays[`${name}:high`];
  const { offset } = sweep.arrays;
  const found = { low: Infinity, high: -Infinity, exact: true };
  let count = 0;
  let sum = 0;
  let squares = 0;
  for (let point = 0; point < (low?.length ?? 0); point++) {
    const time_s = offset[point] / sweep.rate_hz;
    if (time_s < from_s || time_s > to_s || Number.isNaN(low[point])) continue;
    const [least, most] = [low[point], high[point]];
    const middle = (least + most) / 2;
    if (least < found.low) found.low = least;
    if (most > found.high) found.high = most;
    if (least !== most) found.exact = false;
    count += 1;
    sum += middle;
    squares += middle * middle + ((most - least) * (most - least)) / 12; // as if evenly spread within a pixel
  }
  if (count === 0) return null;
  if (offset.length > 1 && offset[1] - offset[0] > 1) found.exact = false;
  found.mean = sum / count;
  found.rms = Math.sqrt(squares / count);
  found.deviation = Math.sqrt(Math.max(0, squares / count - found.mean ** 2));
  return found;
}

/** The value of a trace at a time in s: of the nearest point, in the middle of its band. */
export function valueAt(sweep, name, time_s) {
  const { offset } = sweep.arrays;
  const wanted = time_s * sweep.rate_hz;
  let first = 0;
  let last = offset.length - 1;
  while (last - first > 1) {
    const middle = (first + last) >> 1;
    if (offset[middle] <= wanted) first = middle;
    else last = middle;
  }
  const nearest = Math.abs(offset[last] - wanted) < Math.abs(offset[first] - wanted) ? last : first;
  const low = sweep.arrays[`${name}:low`];
  return low ? (low[nearest] + sweep.arrays[`${name}:high`][nearest]) / 2 : NaN;
}
