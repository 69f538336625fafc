/** Contents of the renderer's textures: 16 floats of geometry per row, and SH coefficients in half precision. */

/**
 * Floats of a row: mean xyz, logit of the opacity | quaternion xyzw | log-scales xyz, logit of the confidence |
 * displacement xyz, unused. Shaders apply exponentials faster.
 */
export const GEOMETRY = 16;
/** Place of the logit of the opacity, and its value in a free row. */
export const OPACITY = 3;
export const FREE = -1e9;
/** Place of the logit of the confidence. */
export const CONFIDENCE = 11;
export const DISPLACEMENT = 12;
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
