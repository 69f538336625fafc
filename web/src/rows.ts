/** From a state to the contents of the renderer's textures. */

import { type Change, type State, step } from "./state";
import { COEFFICIENT, CONFIDENCE, DISPLACEMENT, FREE, GEOMETRY, OPACITY, type Update } from "./update";

/** Return the contents of all rows of a state, with the displacements of the change that led to it, if there is one. */
export function everything(state: State, change: Change | null): Update {
  const update = updated(state, state.order, 0, true);
  if (change !== null) displace(update, change, Math.max(state.ids.length, 1));
  return update;
}

/** Return the rows that a change affects; `before` are those that the change before it displaced. */
export function difference(state: State, change: Change, before: Uint32Array): Update {
  const listed = new Uint8Array(state.ids.length);
  // Loops by index: those over iterators and closures are several times as slow.
  for (let k = 0; k < change.freed.length; k++) listed[change.freed[k]] = 1;
  for (let k = 0; k < change.rows.length; k++) listed[change.rows[k]] = 1;
  const atRest = new Uint32Array(before.length);
  let count = 0;
  for (let k = 0; k < before.length; k++) if (listed[before[k]] === 0) atRest[count++] = before[k];
  const rows = new Uint32Array(change.rows.length + count + change.freed.length);
  rows.set(change.rows);
  rows.set(atRest.subarray(0, count), change.rows.length);
  rows.set(change.freed, change.rows.length + count);
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
  const [x, y, z, a, b, c, first, second, third, opacities] = values;
  const [ofMeans, ofA, ofB, ofC, ofQuats, ofOpacities] = exponents;
  for (let k = 0; k < rows.length; k++) {
    const row = rows[k];
    const at = GEOMETRY * k;
    const mean = step(ofMeans[row]);
    geometry[at] = x[row] * mean;
    geometry[at + 1] = y[row] * mean;
    geometry[at + 2] = z[row] * mean;
    geometry[at + OPACITY] = opacities[row] * step(ofOpacities[row]);
    const quat = step(ofQuats[row]);
    const u = first[row] * quat;
    const v = second[row] * quat;
    const w = third[row] * quat;
    const unit = 1 / Math.sqrt(1 + u * u + v * v + w * w);
    // The stream's order is wxyz, with the largest component left out; the renderer's is xyzw.
    const omitted = largest[row];
    geometry[at + 7] = unit * (omitted === 0 ? 1 : u);
    geometry[at + 4] = unit * (omitted === 0 ? u : omitted === 1 ? 1 : v);
    geometry[at + 5] = unit * (omitted <= 1 ? v : omitted === 2 ? 1 : w);
    geometry[at + 6] = unit * (omitted === 3 ? 1 : w);
    geometry[at + 8] = a[row] * step(ofA[row]);
    geometry[at + 9] = b[row] * step(ofB[row]);
    geometry[at + 10] = c[row] * step(ofC[row]);
  }
  if (!confidence) return;
  const [logits, ofLogits] = [values[values.length - 1], exponents[8]];
  for (let k = 0; k < rows.length; k++) geometry[GEOMETRY * k + CONFIDENCE] = logits[rows[k]] * step(ofLogits[rows[k]]);
}

function fillCoefficients(state: State, rows: Uint32Array, K: number, sh: Uint16Array): void {
  const { values, exponents } = state;
  const words = new Uint32Array(sh.buffer);
  const color = new Float32Array(3);
  const bits = new Uint32Array(color.buffer);
  for (let c = 0; c < K; c++) {
    const [red, green, blue] = values.slice(10 + 3 * c, 13 + 3 * c);
    const exponent = exponents[c === 0 ? 6 : 7];
    for (let k = 0, to = 2 * c; k < rows.length; k++, to += 2 * K) {
      const row = rows[k];
      const unit = TO_HALF * step(exponent[row]);
      color[0] = red[row] * unit;
      color[1] = green[row] * unit;
      color[2] = blue[row] * unit;
      words[to] = half(bits[0]) | (half(bits[1]) << 16);
      words[to + 1] = half(bits[2]);
    }
  }
}

/** Factor that gives a float32 the exponent of a float16; numbers that are subnormal there are so here. */
const TO_HALF = 2 ** -112;
const LARGEST = 0x7bff;

/** Return the bits of the nearest float16 to a float32 times `TO_HALF`; values beyond its range become its largest. */
function half(bits: number): number {
  const rounded = ((bits & 0x7fffffff) + 0x1000) >>> 13;
  return ((bits >>> 16) & 0x8000) | (rounded < LARGEST ? rounded : LARGEST);
}
