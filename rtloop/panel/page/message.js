// What the server sends: the length of a JSON header, the header, then arrays of numbers.

const TYPES = { float32: Float32Array, float64: Float64Array };

/** {kind, …, arrays: {name: numbers}} of a binary message, or of a text that is JSON alone. */
export function decode(data) {
  if (typeof data === "string") return { ...JSON.parse(data), arrays: {} };
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const arrays = {};
  let place = 4 + length;
  for (const [name, count, type = "float32"] of header.arrays ?? []) {
    const Numbers = TYPES[type];
    const end = place + count * Numbers.BYTES_PER_ELEMENT;
    arrays[name] =
      place % Numbers.BYTES_PER_ELEMENT === 0
        ? new Numbers(data, place, count)
        : new Numbers(data.slice(place, end));
    place = end;
  }
  return { ...header, arrays };
}
