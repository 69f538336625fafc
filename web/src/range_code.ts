/** The range code of docs/stream-format.md, decoded by wasm/range_code.ts. */

import wasm from "wasm:range_code";

interface Exports {
  memory: WebAssembly.Memory;
  heap(): number;
  open(words: number, count: number): void;
  take(n: number, column: number): number;
  takeFlags(n: number, flags: number): number;
}

const { memory, heap, open, take, takeFlags } = new WebAssembly.Instance(new WebAssembly.Module(wasm)).exports as unknown as Exports;
const PAGE = 2 ** 16;
const BROKEN = "the range code is broken";

function reserve(end: number): void {
  const missing = end - memory.buffer.byteLength;
  if (missing > 0) memory.grow(Math.ceil(missing / PAGE));
}

/** Decoder of the columns of one range code; the last one that was made is the one that decodes. */
export class ColumnReader {
  private readonly column: number;

  constructor(words: Uint32Array) {
    const start = (heap() + 3) & ~3;
    this.column = start + words.byteLength;
    reserve(this.column);
    new Uint32Array(memory.buffer, start, words.length).set(words);
    open(start, words.length);
  }

  /** Decode a column of `n` integers, which are valid until the next one is decoded. */
  take(n: number): Int32Array {
    reserve(this.column + 4 * n);
    if (!take(n, this.column)) throw new Error(BROKEN);
    return new Int32Array(memory.buffer, this.column, n);
  }

  /**
   * Decode the flags of `n` Gaussians and return the places of those that change or die, with their flags: the first
   * column in bits 0 to 3, the second or third one in the others. They are valid until the next column is decoded.
   */
  takeFlags(n: number): { places: Int32Array; flags: Int32Array } {
    reserve(this.column + 12 * n);
    const count = takeFlags(n, this.column);
    if (count < 0) throw new Error(BROKEN);
    const { buffer } = memory;
    return { flags: new Int32Array(buffer, this.column, count), places: new Int32Array(buffer, this.column + 8 * n, count) };
  }
}
