// Zip files with stored (not compressed) members: for a KMZ, and photos sent as one upload.

const TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let k = 0; k < 8; k++) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value >>> 0;
});

function crc32(bytes) {
  let value = 0xffffffff;
  for (const each of bytes) value = TABLE[(value ^ each) & 255] ^ (value >>> 8);
  return (value ^ 0xffffffff) >>> 0;
}

function record(signature, fields) {
  const size = 4 + fields.reduce((sum, [width]) => sum + width, 0);
  const view = new DataView(new ArrayBuffer(size));
  view.setUint32(0, signature, true);
  let at = 4;
  for (const [width, value] of fields) {
    if (width === 2) view.setUint16(at, value, true);
    else view.setUint32(at, value, true);
    at += width;
  }
  return new Uint8Array(view.buffer);
}

/** A Blob of a zip file of `{name: Uint8Array}`. */
export function zip(members) {
  return packed(Object.entries(members).map(([name, data]) => ({ name, crc: crc32(data), size: data.length, data })));
}

/** A Blob of a zip file of files; they are read once for their checksums and stay where they are. */
export async function zipOfFiles(files) {
  const members = [];
  for (const file of files) {
    const crc = crc32(new Uint8Array(await file.arrayBuffer()));
    members.push({ name: file.name, crc, size: file.size, data: file });
  }
  return packed(members);
}

const UTF8_NAMES = 0x0800;

function packed(members) {
  const parts = [];
  const directory = [];
  let [offset, directorySize] = [0, 0];
  for (const { name, crc, size, data } of members) {
    const label = new TextEncoder().encode(name);
    const common = [[2, 20], [2, UTF8_NAMES], [2, 0], [2, 0], [2, 0x21], [4, crc], [4, size], [4, size], [2, label.length], [2, 0]];
    const head = record(0x04034b50, common);
    const entry = record(0x02014b50, [[2, 20], ...common, [2, 0], [2, 0], [2, 0], [4, 0], [4, offset]]);
    parts.push(head, label, data);
    directory.push(entry, label);
    offset += head.length + label.length + size;
    directorySize += entry.length + label.length;
  }
  const end = record(0x06054b50, [[2, 0], [2, 0], [2, members.length], [2, members.length], [4, directorySize], [4, offset], [2, 0]]);
  return new Blob([...parts, ...directory, end], { type: "application/zip" });
}
