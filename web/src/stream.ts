/** Packets of a stream (docs/stream-format.md). */

export const KEYFRAME = 1;
export const RESIDUAL = 2;
const HEADER = 0;
const MAGIC = "MORGS-MI";
const VERSION = 2;
const PREAMBLE = 12;
const HEAD = 20;
/** Memory of a stream that grows, as a multiple of its bytes: it is copied only now and then. */
const SPARE = 1.25;

export interface CameraFields {
  name: string;
  K: number[][];
  viewmat: number[][];
  width: number;
  height: number;
  near: number;
  /** PNG image behind all Gaussians, base64. */
  background?: string;
}

export interface PacketPlace {
  kind: number;
  frame: number;
  start: number;
  stop: number;
}

export interface Stream {
  bytes: Uint8Array;
  cameras: CameraFields[];
  fps: number;
  metadata: Record<string, unknown>;
  /** Keyframes and residuals in the order of the file. */
  packets: PacketPlace[];
  /** Byte after the last complete packet. */
  end: number;
  /** Description of what ends the file before its end, if anything does. */
  damage: string | null;
}

export async function download(address: string | URL): Promise<Uint8Array<ArrayBuffer>> {
  const response = await fetch(address).catch(() => null);
  if (response === null) throw new Error(`${address} cannot be read; a web server must serve it`);
  if (!response.ok) throw new Error(`${address} cannot be read: ${response.status} ${response.statusText}`);
  return new Uint8Array(await response.arrayBuffer());
}

/** Parse the header and find the packets; checksums are checked when a packet is opened. */
export function openStream(bytes: Uint8Array): Stream {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const magic = String.fromCharCode(...bytes.subarray(0, MAGIC.length));
  if (magic !== MAGIC || bytes.length < PREAMBLE) throw new Error("this is not a .morgs stream");
  const version = view.getUint32(8, true);
  if (version !== VERSION) throw new Error(`expected format version ${VERSION}, found ${version}`);
  const stream: Stream = { bytes, cameras: [], fps: 0, metadata: {}, packets: [], end: PREAMBLE, damage: null };
  const header = scan(stream)[0];
  if (header?.kind !== HEADER) throw new Error("the header of the stream is missing");
  const { cameras, fps, metadata } = JSON.parse(new TextDecoder().decode(openPacket(bytes, header)));
  return { ...stream, cameras, fps, metadata: metadata ?? {} };
}

/** Add the bytes by which a stream has grown, and return the places of their keyframes and residuals. */
export function extend(stream: Stream, more: Uint8Array): PacketPlace[] {
  const { bytes, packets } = stream;
  const size = bytes.length + more.length;
  let buffer = bytes.buffer;
  if (size > buffer.byteLength) {
    buffer = new ArrayBuffer(Math.ceil(SPARE * size));
    new Uint8Array(buffer).set(bytes);
  }
  stream.bytes = new Uint8Array(buffer, 0, size);
  stream.bytes.set(more, bytes.length);
  const count = packets.length;
  scan(stream);
  return packets.slice(count);
}

/** Find the complete packets after `end` and return their places. */
function scan(stream: Stream): PacketPlace[] {
  const { bytes, packets } = stream;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const places: PacketPlace[] = [];
  stream.damage = null;
  while (stream.end < bytes.length) {
    const start = stream.end;
    const complete = start + HEAD <= bytes.length;
    const stop = complete ? start + HEAD + Number(view.getBigUint64(start + 8, true)) : Infinity;
    if (stop > bytes.length) {
      stream.damage = `the stream is truncated or damaged at byte ${start} of ${bytes.length}`;
      break;
    }
    places.push({ kind: view.getUint32(start, true), frame: view.getUint32(start + 4, true), start, stop });
    stream.end = stop;
  }
  packets.push(...places.filter(({ kind }) => kind === KEYFRAME || kind === RESIDUAL));
  return places;
}

/** Return the payload of a packet after checking its CRC. */
export function openPacket(bytes: Uint8Array, place: PacketPlace): Uint8Array {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const payload = bytes.subarray(place.start + HEAD, place.stop);
  const head = bytes.subarray(place.start, place.start + HEAD - 4);
  if (crc32(payload, crc32(head)) !== view.getUint32(place.start + HEAD - 4, true)) {
    throw new Error(`the packet at byte ${place.start} is damaged, its checksum is wrong`);
  }
  return payload;
}

/** Return the arrays of a payload by name; only uint8 and uint32 occur in the packets that are read. */
export function openArrays(payload: Uint8Array): Record<string, Uint8Array | Uint32Array> {
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  let at = 4 + view.getUint32(0, true);
  const found: Record<string, Uint8Array | Uint32Array> = {};
  for (const [name, dtype, shape] of JSON.parse(new TextDecoder().decode(payload.subarray(4, at)))) {
    const count = (shape as number[]).reduce((a, b) => a * b, 1);
    const end = at + count * (dtype === "uint8" ? 1 : 4);
    if (!(end <= payload.length)) throw new Error(`the array ${name} does not fit its packet`);
    // A copy, because the words of a packet may lie at any address.
    const data = payload.slice(at, end);
    found[name] = dtype === "uint8" ? data : new Uint32Array(data.buffer);
    at = end;
  }
  return found;
}

/** Contribution of a byte to the CRC, with 0 to 3 further bytes behind it. */
const CRC_TABLES = Array.from({ length: 4 }, () => new Uint32Array(256));
for (let n = 0; n < 256; n++) {
  let crc = n;
  for (let k = 0; k < 8; k++) crc = crc & 1 ? 0xedb88320 ^ (crc >>> 1) : crc >>> 1;
  CRC_TABLES[0][n] = crc;
}
for (let n = 0; n < 256; n++) {
  for (let k = 1; k < 4; k++) {
    const before = CRC_TABLES[k - 1][n];
    CRC_TABLES[k][n] = CRC_TABLES[0][before & 0xff] ^ (before >>> 8);
  }
}

/** CRC-32 of zlib, four bytes at a time. */
function crc32(bytes: Uint8Array, before = 0): number {
  const [last, third, second, first] = CRC_TABLES;
  let crc = ~before;
  let i = 0;
  for (; i + 4 <= bytes.length; i += 4) {
    crc ^= bytes[i] | (bytes[i + 1] << 8) | (bytes[i + 2] << 16) | (bytes[i + 3] << 24);
    crc = first[crc & 0xff] ^ second[(crc >>> 8) & 0xff] ^ third[(crc >>> 16) & 0xff] ^ last[crc >>> 24];
  }
  for (; i < bytes.length; i++) crc = last[(crc ^ bytes[i]) & 0xff] ^ (crc >>> 8);
  return ~crc >>> 0;
}
