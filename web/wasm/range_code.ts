// The range code and the columns of docs/stream-format.md, in AssemblyScript, because JavaScript has no fast 64-bit
// integers. The caller owns the memory from `heap()` on, and places the words of the code and the columns there.

const TOKENS: i32 = 85;
const TOTAL: f64 = 16777216;
/** Symbols are looked up by the upper 8 bits of their position. */
const BUCKETS: i32 = 256;

const weights = memory.data(TOKENS * 4);
const lefts = memory.data((TOKENS + 1) * 4);
const buckets = memory.data(BUCKETS);

let next: usize = 0;
let end: usize = 0;
let range: u64 = 0;
/** `point` - `low` of the format's page, of which only the difference matters. */
let point: u64 = 0;

/** Return the first address that the caller may use. */
export function heap(): usize {
  return __heap_base;
}

/** Start to read a code of `count` words. */
export function open(words: usize, count: i32): void {
  next = words;
  end = words + (<usize>count << 2);
  range = u64.MAX_VALUE;
  point = word() << 32;
  point |= word();
}

/** Decode a column of n numbers, int32, and return whether the code is sound. */
export function take(n: i32, column: usize): bool {
  if (n > 0) resetWeights();
  let stop = 16;
  for (let start = 0; start < n; start = stop, stop *= 2) {
    stop = min(stop, n);
    updateIntervals();
    const zero = load<u32>(lefts + 4);
    const mostlyZero = zero > <u32>TOTAL / 2;
    for (let i = start; i < stop; i++) {
      let token = 0;
      const scale = range >> 24;
      if (mostlyZero && point < scale * zero) narrow(scale, 0, zero); // saves a division
      else token = symbol();
      if (token < 0) return false;
      store<i32>(column + (<usize>i << 2), token);
    }
    for (let i = start; i < stop; i++) {
      const weight = weights + (load<i32>(column + (<usize>i << 2)) << 2);
      store<i32>(weight, load<i32>(weight) + 32);
    }
  }
  for (let i = 0; i < n; i++) {
    const at = column + (<usize>i << 2);
    const token = load<i32>(at);
    let size = (token + 1) >> 1;
    if (size >= 16) {
      const bits = size - 12;
      const low = equal(min(bits, 16));
      if (low < 0) return false;
      size = (1 << bits) | low;
    }
    store<i32>(at, token & 1 ? size : -size);
  }
  for (let i = 0; i < n; i++) {
    const at = column + (<usize>i << 2);
    const value = load<i32>(at);
    const bits = 31 - clz(abs(value));
    if (bits > 16) {
      const high = equal(bits - 16);
      if (high < 0) return false;
      store<i32>(at, value > 0 ? value + (high << 16) : value - (high << 16));
    }
  }
  return true;
}

function resetWeights(): void {
  for (let i = 0; i < TOKENS; i++) store<i32>(weights + (i << 2), max(1, 256 / ((i + 1) * (i + 1))));
}

function updateIntervals(): void {
  let sum = 0;
  for (let i = 0; i < TOKENS; i++) sum += load<i32>(weights + (i << 2));
  const scale = (TOTAL - <f64>TOKENS) / <f64>sum;
  let before = 0;
  let bucket = 0;
  for (let i = 0; i < TOKENS; i++) {
    store<u32>(lefts + (i << 2), <u32>Math.floor(scale * <f64>before) + i);
    before += load<i32>(weights + (i << 2));
  }
  store<u32>(lefts + (TOKENS << 2), <u32>TOTAL);
  for (let i = 0; i < TOKENS; i++) {
    const right = load<u32>(lefts + ((i + 1) << 2));
    for (; bucket < BUCKETS && <u32>bucket << 16 < right; bucket++) store<u8>(buckets + bucket, <u8>i);
  }
}

/** Decode a token; -1: the code is broken. */
function symbol(): i32 {
  const scale = range >> 24;
  const position = point / scale;
  if (position >> 24) return -1;
  let token = <i32>load<u8>(buckets + <usize>(position >> 16));
  while (<u64>load<u32>(lefts + ((token + 1) << 2)) <= position) token++;
  const left = load<u32>(lefts + (token << 2));
  narrow(scale, left, load<u32>(lefts + ((token + 1) << 2)) - left);
  return token;
}

/** Decode bits of equal probability, at most 16; -1: the code is broken. */
function equal(bits: i32): i32 {
  const scale = range >> 24;
  const position = point / scale;
  if (position >> 24) return -1;
  const width = 24 - bits;
  const value = <u32>position >> width;
  narrow(scale, value << width, 1 << width);
  return value;
}

// @ts-ignore: decorator
@inline
function narrow(scale: u64, left: u32, width: u32): void {
  point -= scale * left;
  range = scale * width;
  if (range >> 32 == 0) {
    range <<= 32;
    point = (point << 32) | word();
  }
}

function word(): u64 {
  if (next >= end) return 0;
  const found = load<u32>(next);
  next += 4;
  return found;
}
