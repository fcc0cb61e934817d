// A zip file with stored (not compressed) members: enough for a KMZ.

const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let k = 0; k < 8; k++) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value >>> 0;
});

/** The CRC-32 of bytes (IEEE 802.3). */
export function crc32(bytes) {
  let value = 0xffffffff;
  for (const each of bytes) value = TABLE[(value ^ each) & 255] ^ (value >>> 8);
  return (value ^ 0xffffffff) >>> 0;
}

function record(signature, fields, ...tail) {
  const size = 4 + fields.reduce((sum, [width]) => sum + width, 0);
  const view = new DataView(new ArrayBuffer(size));
  view.setUint32(0, signature, true);
  let at = 4;
  for (const [width, value] of fields) {
    if (width === 2) view.setUint16(at, value, true);
    else view.setUint32(at, value, true);
    at += width;
  }
  return [new Uint8Array(view.buffer), ...tail];
}

/** A Blob of a zip file of `{name: Uint8Array}`; names are plain ASCII. */
export function zip(members, type = "application/zip") {
  const parts = [];
  const directory = [];
  let offset = 0;
  let directorySize = 0;
  for (const [name, data] of Object.entries(members)) {
    const label = new TextEncoder().encode(name);
    const crc = crc32(data);
    const common = [[2, 20], [2, 0], [2, 0], [2, 0], [2, 0x21], [4, crc], [4, data.length], [4, data.length], [2, label.length], [2, 0]];
    const local = record(0x04034b50, common, label, data);
    const central = record(0x02014b50, [[2, 20], ...common, [2, 0], [2, 0], [2, 0], [4, 0], [4, offset]], label);
    parts.push(...local);
    directory.push(...central);
    offset += local.reduce((sum, each) => sum + each.length, 0);
    directorySize += central.reduce((sum, each) => sum + each.length, 0);
  }
  const count = Object.keys(members).length;
  const end = record(0x06054b50, [[2, 0], [2, 0], [2, count], [2, count], [4, directorySize], [4, offset], [2, 0]]);
  return new Blob([...parts, ...directory, ...end], { type });
}
