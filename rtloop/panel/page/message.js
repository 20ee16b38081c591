// Messages from the server: the length of a JSON header, the header, then arrays of 32-bit numbers.

/** {kind, …, arrays: {name: numbers}} of a binary message, whose header ends where numbers may begin. */
export function decode(data) {
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const arrays = {};
  let place = 4 + length;
  for (const [name, count] of header.arrays) {
    arrays[name] = new Float32Array(data, place, count);
    place += arrays[name].byteLength;
  }
  return { ...header, arrays };
}
