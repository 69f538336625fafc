/** Contents of the renderer's textures: 16 floats of geometry per row, and SH coefficients in half precision. */

import { type Change, type State, step } from "./state";

/**
 * Floats of a row: mean xyz, logit of the opacity | quaternion xyzw | log-scales xyz, logit of the confidence |
 * displacement xyz, unused. Shaders apply exponentials faster.
 */
export const GEOMETRY = 16;
/** Place of the logit of the opacity, and its value in a free row. */
export const OPACITY = 3;
export const FREE = -1e9;
const DISPLACEMENT = 12;
/** Halves per SH coefficient: R, G, B and one unused. */
export const COEFFICIENT = 4;

/** New contents of some rows; after a reset, all others are free. */
export interface Update {
  reset: boolean;
  /** Number of rows, free ones included. */
  capacity: number;
  /** Number of Gaussians. */
  count: number;
  degree: number;
  confidence: boolean;
  rows: Uint32Array;
  geometry: Float32Array;
  sh: Uint16Array;
}

/** Return the contents of all rows of a state, with the displacements of the change that led to it, if there is one. */
export function everything(state: State, change: Change | null): Update {
  const update = updated(state, state.order, 0, true);
  if (change !== null) displace(update, change, Math.max(state.ids.length, 1));
  return update;
}

/** Return the rows that a change affects; `before` are those that the change before it displaced. */
export function difference(state: State, change: Change, before: Uint32Array): Update {
  const listed = new Uint8Array(state.ids.length);
  for (const row of change.freed) listed[row] = 1;
  for (const row of change.rows) listed[row] = 1;
  const atRest = before.filter((row) => listed[row] === 0);
  const rows = new Uint32Array(change.rows.length + atRest.length + change.freed.length);
  rows.set(change.rows);
  rows.set(atRest, change.rows.length);
  rows.set(change.freed, change.rows.length + atRest.length);
  const update = updated(state, rows, change.freed.length, false);
  displace(update, change, state.ids.length);
  return update;
}

function displace({ rows, geometry }: Update, { moved, displacements }: Change, capacity: number): void {
  const place = new Uint32Array(capacity);
  for (let k = 0; k < rows.length; k++) place[rows[k]] = k;
  for (let k = 0; k < moved.length; k++) {
    const at = GEOMETRY * place[moved[k]] + DISPLACEMENT;
    for (let axis = 0; axis < 3; axis++) geometry[at + axis] = displacements[3 * k + axis];
  }
}

/** Return the contents of rows, of which the last ones are free. */
function updated(state: State, rows: Uint32Array, free: number, reset: boolean): Update {
  const K = (state.degree + 1) ** 2;
  const geometry = new Float32Array(GEOMETRY * rows.length);
  const sh = new Uint16Array(COEFFICIENT * K * rows.length);
  const members = rows.subarray(0, rows.length - free);
  fillGeometry(state, members, geometry);
  for (let k = members.length; k < rows.length; k++) geometry[GEOMETRY * k + OPACITY] = FREE;
  fillCoefficients(state, members, K, sh);
  const { degree, confidence } = state;
  return { reset, capacity: state.ids.length, count: state.order.length, degree, confidence, rows: rows.slice(), geometry, sh };
}

function fillGeometry(state: State, rows: Uint32Array, geometry: Float32Array): void {
  const { values, exponents, largest, confidence } = state;
  const logits = values[values.length - 1];
  for (let k = 0; k < rows.length; k++) {
    const row = rows[k];
    const at = GEOMETRY * k;
    const ofMeans = step(exponents[0][row]);
    for (let axis = 0; axis < 3; axis++) {
      geometry[at + axis] = values[axis][row] * ofMeans;
      geometry[at + 8 + axis] = values[3 + axis][row] * step(exponents[1 + axis][row]);
    }
    geometry[at + OPACITY] = values[9][row] * step(exponents[5][row]);
    const ofQuats = step(exponents[4][row]);
    const u = values[6][row] * ofQuats;
    const v = values[7][row] * ofQuats;
    const w = values[8][row] * ofQuats;
    const unit = 1 / Math.sqrt(1 + u * u + v * v + w * w);
    // The stream's order is wxyz, with the largest component left out; the renderer's is xyzw.
    const omitted = largest[row];
    geometry[at + 7] = unit * (omitted === 0 ? 1 : u);
    geometry[at + 4] = unit * (omitted === 0 ? u : omitted === 1 ? 1 : v);
    geometry[at + 5] = unit * (omitted <= 1 ? v : omitted === 2 ? 1 : w);
    geometry[at + 6] = unit * (omitted === 3 ? 1 : w);
    if (confidence) geometry[at + 11] = logits[row] * step(exponents[8][row]);
  }
}

function fillCoefficients(state: State, rows: Uint32Array, K: number, sh: Uint16Array): void {
  const { values, exponents } = state;
  for (let c = 0; c < 3 * K; c++) {
    const column = values[10 + c];
    const exponent = exponents[c < 3 ? 6 : 7];
    const place = COEFFICIENT * Math.floor(c / 3) + (c % 3);
    for (let k = 0; k < rows.length; k++) {
      sh[COEFFICIENT * K * k + place] = half(column[rows[k]] * step(exponent[rows[k]]));
    }
  }
}

const FLOAT = new Float32Array(1);
const BITS = new Uint32Array(FLOAT.buffer);

/** Return the bits of the nearest float16; values beyond its range become its largest. */
function half(value: number): number {
  FLOAT[0] = Math.max(-65504, Math.min(65504, value));
  const bits = BITS[0];
  const sign = (bits >>> 16) & 0x8000;
  const size = bits & 0x7fffffff;
  if (size < 0x38800000) return sign | Math.round(Math.abs(FLOAT[0]) * 2 ** 24); // subnormal
  return sign | ((size - 0x38000000 + 0x1000) >>> 13);
}
