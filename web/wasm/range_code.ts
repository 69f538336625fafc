// The range code and the columns of docs/stream-format.md, in AssemblyScript, because JavaScript has no fast 64-bit
// integers. The caller owns the memory from `heap()` on, and places the words of the code and the columns there.

const TOKENS: i32 = 85;
const TOTAL: f64 = 16777216;
/** Symbols are looked up by the upper 8 bits of their position. */
const BUCKETS: i32 = 256;
const IN_BUCKET = 16;
/** Tokens from which on a number has low bits, and more than 16. */
const DIRECT = 31;
const LONG = 57;
/** Flag of a Gaussian that died. */
const DIED: u32 = 8;

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
  let largest = 0;
  let stop = 16;
  for (let start = 0; start < n; start = stop, stop *= 2) {
    stop = min(stop, n);
    updateIntervals();
    if (!takeTokens(column + (<usize>start << 2), column + (<usize>stop << 2))) return false;
    largest = max(largest, countTokens(column + (<usize>start << 2), column + (<usize>stop << 2)));
  }
  const end = column + (<usize>n << 2);
  return largest < DIRECT || (takeBits(column, end, 0, 4) && (largest < LONG || takeBits(column, end, 16, 17)));
}

/**
 * Decode the flags of n Gaussians, of which `flags` has room for 3 n, and return how many change or die, -1: the code is
 * broken. Their flags are then the first of `flags`, those of the first column in the bits 0 to 3, and their places
 * begin at 2 n.
 */
export function takeFlags(n: i32, flags: usize): i32 {
  if (!take(n, flags)) return -1;
  const more = flags + (<usize>n << 2);
  const places = more + (<usize>n << 2);
  let still = 0;
  let others = 0;
  for (let at = flags; at < more; at += 4) {
    const flag = load<u32>(at);
    still += i32(flag == 0);
    others += i32(flag - 1 < DIED - 1);
  }
  let ofStill = more;
  let ofOthers = more + (<usize>still << 2);
  if (!take(still, ofStill) || !take(others, ofOthers)) return -1;
  let count: usize = 0;
  for (let k = 0; k < n; k++) {
    let flag = load<u32>(flags + (<usize>k << 2));
    if (flag == 0) {
      flag = load<u32>(ofStill) << 4;
      ofStill += 4;
    } else if (flag < DIED) {
      flag |= load<u32>(ofOthers) << 4;
      ofOthers += 4;
    }
    store<u32>(flags + count, flag);
    store<i32>(places + count, k);
    count += <usize>(flag != 0) << 2;
  }
  return <i32>(count >> 2);
}

/** Decode the tokens of a block. */
function takeTokens(at: usize, end: usize): bool {
  const zero: u64 = load<u32>(lefts + 4);
  const mostlyZero = zero > <u64>TOTAL / 2;
  let r = range;
  let p = point;
  for (; at < end; at += 4) {
    const scale = r >> 24;
    let token = 0;
    let left: u64 = 0;
    let right = zero;
    // Without the division that finds other tokens.
    if (!mostlyZero || p >= scale * zero) {
      const position = p / scale;
      if (position >> 24) return false;
      token = <i32>load<u8>(buckets + <usize>(position >> IN_BUCKET));
      while ((right = load<u32>(lefts + ((token + 1) << 2))) <= position) token++;
      left = load<u32>(lefts + (token << 2));
    }
    store<i32>(at, token);
    p -= scale * left;
    r = scale * (right - left);
    if (r >> 32 == 0) {
      r <<= 32;
      p = (p << 32) | word();
    }
  }
  range = r;
  point = p;
  return true;
}

/** Count the tokens of a block, replace them by the numbers that they stand for, and return the largest token. */
function countTokens(at: usize, end: usize): i32 {
  let largest = 0;
  for (; at < end; at += 4) {
    const token = load<i32>(at);
    const weight = weights + (<usize>token << 2);
    store<i32>(weight, load<i32>(weight) + 32);
    largest = max(largest, token);
    const size = (token + 1) >> 1;
    store<i32>(at, token & 1 ? size : -size);
  }
  return largest;
}

/** Decode at most 16 bits, from bit `shift` on, of the numbers with at least `least` bits below their highest one. */
function takeBits(at: usize, end: usize, shift: i32, least: i32): bool {
  let r = range;
  let p = point;
  for (; at < end; at += 4) {
    const value = load<i32>(at);
    const size = abs(value);
    const count = shift ? 31 - clz(size) : size - 12;
    if (count < least) continue;
    const scale = r >> 24;
    const position = p / scale;
    if (position >> 24) return false;
    const width = 24 - min(count - shift, 16);
    const bits = <i32>position >> width;
    const found = (shift ? size : 1 << count) | (bits << shift);
    store<i32>(at, value > 0 ? found : -found);
    p -= scale * <u64>(bits << width);
    r = scale << width;
    if (r >> 32 == 0) {
      r <<= 32;
      p = (p << 32) | word();
    }
  }
  range = r;
  point = p;
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
    for (; bucket < BUCKETS && <u32>bucket << IN_BUCKET < right; bucket++) store<u8>(buckets + bucket, <u8>i);
  }
}

function word(): u64 {
  if (next >= end) return 0;
  const found = load<u32>(next);
  next += 4;
  return found;
}
