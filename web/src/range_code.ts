/** The range code of docs/stream-format.md, decoded by wasm/range_code.ts. */

import wasm from "wasm:range_code";

interface Exports {
  memory: WebAssembly.Memory;
  heap(): number;
  open(words: number, count: number): void;
  take(n: number, column: number): number;
}

const { memory, heap, open, take } = new WebAssembly.Instance(new WebAssembly.Module(wasm)).exports as unknown as Exports;
const PAGE = 2 ** 16;

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
    if (!take(n, this.column)) throw new Error("the range code is broken");
    return new Int32Array(memory.buffer, this.column, n);
  }
}
