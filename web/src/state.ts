/** The state of a decoder and its changes by keyframes and residuals (docs/stream-format.md). */

import { ColumnReader } from "./range_code";

type Arrays = Record<string, Uint8Array | Uint32Array>;

const F = [1, 1.189207115002721, 1.4142135623730951, 1.681792830507429];
const MAX_QUANTIZER_STEP = 80;
const PER_WORD = 16;
const DIED = 8;

function quarterOctaves(exponent: number): number {
  return F[exponent & 3] * 2 ** Math.floor(exponent / 4);
}

const STEPS = Float64Array.from({ length: 256 }, (_, i) => quarterOctaves(i - 128));

/** Return the unit of numbers with an int8 exponent. */
export function step(exponent: number): number {
  return STEPS[exponent + 128];
}

/**
 * Integers of N Gaussians. Each has a row for life, the same in all columns and in the textures of the renderer, so that
 * births and deaths move nothing.
 */
export interface State {
  frame: number;
  degree: number;
  /** Whether there is a column of the confidence, the last one. */
  confidence: boolean;
  nextId: number;
  /** Rows of the Gaussians [N] in the order of their ids. */
  order: Uint32Array;
  /** Rows without a Gaussian. */
  free: number[];
  ids: Uint32Array;
  largest: Uint8Array;
  exponents: Int8Array[];
  values: Int32Array[];
}

/** What a residual has changed. */
export interface Change {
  /** Rows of the changed survivors and of the births. */
  rows: Uint32Array;
  /** Rows that are now free. */
  freed: number[];
  /** Rows of the survivors whose means have changed, with their displacements xyz, world units. */
  moved: Uint32Array;
  displacements: Float32Array;
}

type Column = Uint8Array | Int8Array | Uint32Array | Int32Array;

/** Return a state with each of its columns replaced. */
function mapped(state: State, map: <T extends Column>(column: T) => T): State {
  const { ids, largest, exponents, values } = state;
  const columns = { ids: map(ids), largest: map(largest), exponents: exponents.map(map), values: values.map(map) };
  return { ...state, ...columns };
}

export function copyOf(state: State): State {
  const copied = mapped(state, <T extends Column>(column: T) => column.slice() as T);
  return { ...copied, order: state.order.slice(), free: [...state.free] };
}

/** Return the state with its columns in the order of the ids, without free rows. */
export function ordered(state: State): State {
  const packed = mapped(state, <T extends Column>(column: T) => {
    const result = new (column.constructor as new (n: number) => T)(state.order.length);
    for (let i = 0; i < result.length; i++) result[i] = column[state.order[i]];
    return result;
  });
  return { ...packed, free: [], order: state.order.map((_, i) => i) };
}

export function bytesOf(state: State): number {
  return state.ids.length * (9 + state.exponents.length + 4 * state.values.length);
}

function columnCounts(degree: number, confidence: boolean): { E: number; C: number } {
  return { E: 8 + Number(confidence), C: 10 + 3 * (degree + 1) ** 2 + Number(confidence) };
}

export function keyframe(frame: number, arrays: Arrays): State {
  const code = arrays.code as Uint32Array;
  const [N, degree, optional, nextId] = arrays.head;
  if (optional > 1) throw new Error("it has attributes that this page does not know");
  if (PER_WORD * code.length < N || degree > 3) throw new Error("its head does not fit its code");
  const confidence = optional === 1;
  const { E, C } = columnCounts(degree, confidence);
  const reader = new ColumnReader(code);
  const gaps = reader.take(N).slice();
  const columns = gaussians(reader, N, 1 + E + C);

  // Gaussians that are likely to move come first, so that updates of the textures touch few of their lines.
  const logits = confidence ? columns[E + C] : null;
  const order = new Uint32Array(N);
  let row = 0;
  for (const moving of [true, false]) {
    for (let i = 0; i < N; i++) if ((logits !== null && logits[i] > 0) === moving) order[i] = row++;
  }
  const ids = new Uint32Array(N);
  for (let i = 0, id = -1; i < N; i++) ids[order[i]] = id += gaps[i] + 1;
  const placed = <T extends Column>(column: Int32Array, result: T) => {
    for (let i = 0; i < N; i++) result[order[i]] = column[i];
    return result;
  };
  const largest = placed(columns[0], new Uint8Array(N));
  const exponents = columns.slice(1, 1 + E).map((column) => placed(column, new Int8Array(N)));
  const values = columns.slice(1 + E).map((column) => placed(column, new Int32Array(N)));
  return { frame, degree, confidence, nextId, order, free: [], ids, largest, exponents, values };
}

/** Decode a group of Gaussians: M columns of N numbers. */
function gaussians(reader: ColumnReader, N: number, M: number): Int32Array[] {
  return Array.from(reader.take(M).slice(), (shift) => {
    const column = reader.take(N).slice();
    if (shift !== 0) for (let i = 0; i < N; i++) column[i] += shift;
    return column;
  });
}

/** Apply a residual to a state, in place; after an error, the state must not be used. */
export function applyResidual(state: State, frame: number, arrays: Arrays): Change {
  const [births, quantizerStep] = arrays.head;
  const code = arrays.code as Uint32Array;
  if (frame !== state.frame + 1) throw new Error(`it does not continue frame ${state.frame}; a packet is missing`);
  if (PER_WORD * code.length < births || quantizerStep > MAX_QUANTIZER_STEP)
    throw new Error("its head does not fit its code");
  const reader = new ColumnReader(code);
  const factor = quarterOctaves(quantizerStep);
  const changes = classes(state).map((members) => applyClass(state, members, reader, factor));

  const freed = changes.flatMap(({ freed }) => freed);
  if (freed.length > 0) remove(state, freed);
  const born = births > 0 ? addBirths(state, reader, births) : new Uint32Array(0);
  state.frame = frame;
  const reused = new Set(born);
  return {
    rows: joined([...changes.map(({ rows }) => rows), born], Uint32Array),
    freed: freed.filter((row) => !reused.has(row)),
    moved: joined(changes.map(({ moved }) => moved), Uint32Array),
    displacements: joined(changes.map(({ displacements }) => displacements), Float32Array),
  };
}

/** Remove Gaussians from the order; their rows are now free. */
function remove(state: State, rows: number[]): void {
  const dead = new Uint8Array(state.ids.length);
  for (const row of rows) {
    dead[row] = 1;
    state.free.push(row);
  }
  state.order = state.order.filter((row) => dead[row] === 0);
}

const buffers: Uint32Array[] = [];

/** Return an array with any contents, valid until the next call with the same number; a new one costs page faults. */
function scratch(which: number, length: number): Uint32Array {
  if (!(buffers[which]?.length >= length)) buffers[which] = new Uint32Array(length);
  return buffers[which];
}

/** Return the rows of the Gaussians with a confidence of at most 1/2, and of the others. */
function classes({ order, confidence, values }: State): Uint32Array[] {
  const still = scratch(0, order.length);
  if (!confidence) {
    still.set(order);
    return [still.subarray(0, order.length), still.subarray(0, 0)];
  }
  const logits = values[values.length - 1];
  const moving = scratch(1, order.length);
  let count = 0;
  // Both are written, because a branch would often be mispredicted.
  for (let i = 0; i < order.length; i++) {
    const row = order[i];
    still[count] = row;
    moving[i - count] = row;
    count += logits[row] > 0 ? 0 : 1;
  }
  return [still.subarray(0, count), moving.subarray(0, order.length - count)];
}

function applyClass(state: State, members: Uint32Array, reader: ColumnReader, factor: number): Change {
  const { places, flags } = reader.takeFlags(members.length);
  const rows = new Uint32Array(places.length);
  const changes = new Int32Array(places.length);
  const freed: number[] = [];
  let count = 0;
  for (let j = 0; j < places.length; j++) {
    const row = members[places[j]];
    if (flags[j] === DIED) freed.push(row);
    else {
      rows[count] = row;
      changes[count++] = flags[j];
    }
  }
  const listed = rows.subarray(0, count);

  const moved = withBit(listed, changes, 1);
  const displacements = new Float32Array(3 * moved.length);
  const { C } = columnCounts(state.degree, false);
  const ends = [0, 3, 6, 9, 10, 13, C, ...(state.confidence ? [C + 1] : [])];
  for (let g = 0; g + 1 < ends.length; g++) {
    const touched = g === 0 ? moved : withBit(listed, changes, g < 3 ? 1 << g : 16 << (g - 3));
    for (let column = ends[g]; column < ends[g + 1]; column++) {
      const r = reader.take(touched.length);
      const values = state.values[column];
      if (g === 0) move(values, state.exponents[0], touched, r, factor, displacements, column);
      else add(values, touched, r, factor);
    }
  }
  return { rows: listed, freed, moved, displacements };
}

/** Change the means along one axis and store the displacements, in float32. */
function move(
  values: Int32Array,
  exponents: Int8Array,
  rows: Uint32Array,
  r: Int32Array,
  factor: number,
  displacements: Float32Array,
  axis: number,
): void {
  for (let k = 0; k < rows.length; k++) {
    const row = rows[k];
    const unit = step(exponents[row]);
    const before = Math.fround(values[row] * unit);
    values[row] += rint(r[k] * factor);
    displacements[3 * k + axis] = Math.fround(values[row] * unit) - before;
  }
}

function add(values: Int32Array, rows: Uint32Array, r: Int32Array, factor: number): void {
  for (let k = 0; k < r.length; k++) values[rows[k]] += rint(r[k] * factor);
}

/** Return the rows whose change has a bit. */
function withBit(rows: Uint32Array, changes: Int32Array, bit: number): Uint32Array {
  const found = new Uint32Array(rows.length);
  let count = 0;
  for (let k = 0; k < rows.length; k++) if ((changes[k] & bit) !== 0) found[count++] = rows[k];
  return found.subarray(0, count);
}

/** Decode births into free rows and new ones, and return their rows. */
function addBirths(state: State, reader: ColumnReader, births: number): Uint32Array {
  const { E, C } = columnCounts(state.degree, state.confidence);
  const columns = gaussians(reader, births, 1 + E + C);
  const rows = new Uint32Array(births);
  let used = state.order.length + state.free.length;
  for (let k = 0; k < births; k++) rows[k] = state.free.pop() ?? used++;
  if (used > state.ids.length) {
    const capacity = Math.ceil(1.25 * used);
    const grown = mapped(state, <T extends Column>(column: T) => {
      const result = new (column.constructor as new (n: number) => T)(capacity);
      result.set(column);
      return result;
    });
    Object.assign(state, grown);
  }
  state.order = joined([state.order, rows], Uint32Array);
  [state.largest, ...state.exponents, ...state.values].forEach((column, c) => {
    for (let k = 0; k < births; k++) column[rows[k]] = columns[c][k];
  });
  for (let k = 0; k < births; k++) state.ids[rows[k]] = state.nextId + k;
  state.nextId += births;
  return rows;
}

/** Round to the nearest integer, halves to the even one. */
function rint(x: number): number {
  return x + 6755399441055744 - 6755399441055744;
}

function joined<T extends Uint32Array | Float32Array>(parts: T[], type: new (n: number) => T): T {
  const result = new type(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    result.set(part, at);
    at += part.length;
  }
  return result;
}
