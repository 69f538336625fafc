/** The Gaussians of a frame as a mesh of Spark: textures that updates change. */

import { dyno, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { COEFFICIENT, CONFIDENCE, FREE, GEOMETRY, OPACITY, type Update } from "./update";

type SplatSource = NonNullable<SplatMesh["splats"]>;
type FrameUpdate = Parameters<SplatMesh["update"]>[0];

/** Texels of a line of the textures. */
const WIDTH = 2048;

/** Distance from a place of the image up to which a Gaussian is taken for what is there, half heights of the image. */
const PICKED = 0.02;

/** A Gaussian in an image: normalised coordinates, depth in world units, and whether it is more likely to move. */
export interface Seen {
  x: number;
  y: number;
  depth: number;
  moves: boolean;
}

/** Return the value below which a fraction of the values lies; undefined: there are none. */
export function quantile(values: number[], fraction = 0.5): number | undefined {
  return values.sort((a, b) => a - b)[Math.floor(fraction * (values.length - 1))];
}

/** Options of a SparkRenderer that draws as the package's renderer does; `metadata` is the stream's. */
export function rendererOptions(metadata: Record<string, unknown>) {
  const { config } = metadata as { config?: { render?: object } };
  const { eps2d, alpha_min: minAlpha } = { eps2d: 0.3, alpha_min: 1 / 255, ...config?.render };
  return {
    accumExtSplats: true,
    preBlurAmount: eps2d,
    blurAmount: 0,
    minAlpha,
    maxStdDev: Math.sqrt(-2 * Math.log(minAlpha)),
    maxPixelRadius: 1e5,
    sortRadial: false,
  };
}

/** Colour behind the Gaussians; `metadata` is the stream's. */
export function background(metadata: Record<string, unknown>): THREE.Color {
  const { config } = metadata as { config?: { render?: { background?: [number, number, number] | null } } };
  return new THREE.Color().setRGB(...(config?.render?.background ?? [0, 0, 0]), THREE.SRGBColorSpace);
}

export const TEXELS = /* glsl */ `
vec4 texelOf(sampler2D rows, int i) {
  return texelFetch(rows, ivec2(i % ${WIDTH}, i / ${WIDTH}), 0);
}

float sigmoid(float x) {
  return 1.0 / (1.0 + exp(-x));
}
`;

// The colours of `_colors` in morgs_mi/render/projection.py.
const COLORS = /* glsl */ `
vec3 colorSeenFrom(sampler2D sh, int row, int degree, vec3 d) {
  int i = row * (degree + 1) * (degree + 1);
  float x = d.x, y = d.y, z = d.z;
  vec3 c = 0.28209479177387814 * texelOf(sh, i).rgb;
  if (degree > 0) {
    c += 0.4886025119029199 * (-y * texelOf(sh, i + 1).rgb + z * texelOf(sh, i + 2).rgb - x * texelOf(sh, i + 3).rgb);
  }
  if (degree > 1) {
    c += 1.0925484305920792 * (x * y * texelOf(sh, i + 4).rgb - y * z * texelOf(sh, i + 5).rgb
      - x * z * texelOf(sh, i + 7).rgb);
    c += 0.31539156525252005 * (3.0 * z * z - 1.0) * texelOf(sh, i + 6).rgb;
    c += 0.5462742152960396 * (x * x - y * y) * texelOf(sh, i + 8).rgb;
  }
  if (degree > 2) {
    c += -0.5900435899266435 * y * (3.0 * x * x - y * y) * texelOf(sh, i + 9).rgb;
    c += 2.890611442640554 * x * y * z * texelOf(sh, i + 10).rgb;
    c += -0.4570457994644658 * y * (5.0 * z * z - 1.0) * texelOf(sh, i + 11).rgb;
    c += 0.3731763325901154 * z * (5.0 * z * z - 3.0) * texelOf(sh, i + 12).rgb;
    c += -0.4570457994644658 * x * (5.0 * z * z - 1.0) * texelOf(sh, i + 13).rgb;
    c += 1.445305721320277 * z * (x * x - y * y) * texelOf(sh, i + 14).rgb;
    c += -0.5900435899266435 * x * (x * x - 3.0 * y * y) * texelOf(sh, i + 15).rgb;
  }
  return max(c + 0.5, 0.0);
}
`;

class Textures implements SplatSource {
  capacity = 0;
  degree = 0;
  readonly uniforms = {
    geometry: new dyno.DynoSampler2D({ key: "geometry", value: texture(1, Float32Array) }),
    sh: new dyno.DynoSampler2D({ key: "sh", value: texture(1, Uint16Array) }),
    degree: new dyno.DynoInt({ key: "degree", value: 0 }),
  };

  get geometry(): Float32Array {
    return this.uniforms.geometry.value.image.data as Float32Array;
  }

  write(update: Update): void {
    const { geometry, sh } = this.uniforms;
    if (update.capacity > this.capacity || update.degree !== this.degree) this.allocate(update.capacity, update.degree);
    if (update.reset) this.geometry.fill(FREE);
    scatter(geometry.value, update.rows, update.geometry, GEOMETRY, update.reset);
    scatter(sh.value, update.rows, update.sh, COEFFICIENT * (update.degree + 1) ** 2, update.reset);
  }

  private allocate(capacity: number, degree: number): void {
    const { geometry, sh } = this.uniforms;
    const before = [geometry.value, sh.value];
    const grown = Math.ceil(1.1 * capacity);
    const colors = degree === this.degree ? (sh.value.image.data as Uint16Array) : undefined;
    geometry.value = texture(4 * grown, Float32Array, this.geometry);
    sh.value = texture((degree + 1) ** 2 * grown, Uint16Array, colors);
    for (const texture of before) texture.dispose();
    [this.capacity, this.degree, this.uniforms.degree.value] = [grown, degree, degree];
  }

  dispose(): void {
    this.uniforms.geometry.value.dispose();
    this.uniforms.sh.value.dispose();
  }

  prepareFetchSplat(): void {}

  setMaxSh(): void {}

  getNumSplats(): number {
    return this.capacity;
  }

  getNumSh(): number {
    return this.degree;
  }

  hasRgbDir(): boolean {
    return this.degree > 0;
  }

  fetchSplat({ index, viewOrigin }: Parameters<SplatSource["fetchSplat"]>[0]): ReturnType<SplatSource["fetchSplat"]> {
    const read = new dyno.Dyno({
      inTypes: { index: "int", eye: "vec3", geometry: "sampler2D", sh: "sampler2D", degree: "int" },
      outTypes: { gsplat: dyno.Gsplat },
      inputs: { index, eye: viewOrigin, ...this.uniforms },
      globals: () => [dyno.defineGsplat, TEXELS, COLORS],
      statements: ({ inputs: i, outputs: { gsplat } }) => dyno.unindentLines(`
        vec4 place = texelOf(${i.geometry}, 4 * ${i.index});
        ${gsplat}.flags = place.w > ${FREE}.0 ? GSPLAT_FLAG_ACTIVE : 0u;
        ${gsplat}.index = ${i.index};
        ${gsplat}.center = place.xyz;
        ${gsplat}.scales = exp(texelOf(${i.geometry}, 4 * ${i.index} + 2).xyz);
        ${gsplat}.quaternion = texelOf(${i.geometry}, 4 * ${i.index} + 1);
        vec3 color = colorSeenFrom(${i.sh}, ${i.index}, ${i.degree}, normalize(place.xyz - ${i.eye}));
        ${gsplat}.rgba = vec4(color, sigmoid(place.w));
      `),
    });
    return read.outputs.gsplat;
  }

  forEachSplat(callback: Parameters<SplatSource["forEachSplat"]>[0]): void {
    const sh = this.uniforms.sh.value.image.data as Uint16Array;
    const [center, scales, quaternion] = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Quaternion()];
    const color = new THREE.Color();
    for (let row = 0; row < this.capacity; row++) {
      const values = this.geometry.subarray(GEOMETRY * row, GEOMETRY * (row + 1));
      if (values[OPACITY] <= FREE) continue;
      const at = COEFFICIENT * (this.degree + 1) ** 2 * row;
      const [red, green, blue] = [0, 1, 2].map((i) => 0.5 + 0.28209479177387814 * THREE.DataUtils.fromHalfFloat(sh[at + i]));
      scales.set(Math.exp(values[8]), Math.exp(values[9]), Math.exp(values[10]));
      const opacity = 1 / (1 + Math.exp(-values[OPACITY]));
      callback(row, center.fromArray(values), scales, quaternion.fromArray(values, 4), opacity, color.setRGB(red, green, blue));
    }
  }
}

export class StreamMesh extends SplatMesh {
  readonly textures: Textures;
  private readonly view = new THREE.Matrix4();

  constructor() {
    const textures = new Textures();
    super({ splats: textures });
    if (this.splats !== textures) throw new Error("Spark 2.0 or newer is needed");
    this.textures = textures;
  }

  /** Spark calls this before an image. Rounding of the camera's pose, as by OrbitControls, must not cause new sorting. */
  override update(context: FrameUpdate): void {
    const before = this.view.elements;
    const moved = context.viewToWorld.elements.some((value, i) => Math.abs(value - before[i]) > 1e-7);
    if (moved) this.view.copy(context.viewToWorld);
    super.update({ ...context, viewToWorld: this.view });
  }

  /** Write an update into the textures. */
  apply(update: Update): void {
    this.textures.write(update);
    // After a reset, the order of the frame before is of no use.
    if (update.reset) this.updateMappingVersion();
    else this.updateVersion();
  }

  /** At most some thousand Gaussians that a camera sees. */
  seen(camera: THREE.PerspectiveCamera): Seen[] {
    const { capacity, geometry } = this.textures;
    this.updateWorldMatrix(true, false);
    camera.updateMatrixWorld();
    const places: Seen[] = [];
    const point = new THREE.Vector3();
    const stride = GEOMETRY * Math.max(1, Math.floor(capacity / 5000));
    for (let at = 0; at < GEOMETRY * capacity; at += stride) {
      if (geometry[at + OPACITY] < -2) continue;
      point.fromArray(geometry, at).applyMatrix4(this.matrixWorld).applyMatrix4(camera.matrixWorldInverse);
      const depth = -point.z;
      const { x, y } = point.applyMatrix4(camera.projectionMatrix);
      if (depth > 0 && Math.abs(x) < 1 && Math.abs(y) < 1) places.push({ x, y, depth, moves: geometry[at + CONFIDENCE] > 0 });
    }
    return places;
  }

  /** Median depth of the Gaussians in front of a camera, in world units. */
  medianDepth(camera: THREE.PerspectiveCamera): number {
    return quantile(this.seen(camera).map(({ depth }) => depth)) ?? 1;
  }

  /** The first opaque surface at a place of the image, in normalised coordinates, or null. */
  surface(camera: THREE.PerspectiveCamera, x: number, y: number): THREE.Vector3 | null {
    const { capacity, geometry } = this.textures;
    camera.updateMatrixWorld();
    const toImage = camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse).multiply(this.matrixWorld);
    const projection = camera.projectionMatrix.elements;
    const aspect = projection[5] / projection[0];
    const point = new THREE.Vector3();
    let nearest = Infinity;
    let result: THREE.Vector3 | null = null;
    for (let at = 0; at < GEOMETRY * capacity; at += GEOMETRY) {
      if (geometry[at + OPACITY] < 0) continue;
      const { x: px, y: py, z } = point.fromArray(geometry, at).applyMatrix4(toImage);
      if (z < -1 || z > nearest || Math.hypot((px - x) * aspect, py - y) > PICKED) continue;
      nearest = z;
      result = new THREE.Vector3().fromArray(geometry, at).applyMatrix4(this.matrixWorld);
    }
    return result;
  }
}

type Texels = Float32ArrayConstructor | Uint16ArrayConstructor;

/** Return a texture for a number of texels RGBA, in floats or halves. */
function texture(texels: number, type: Texels, before?: Float32Array | Uint16Array): THREE.DataTexture {
  const height = Math.max(1, Math.ceil(texels / WIDTH));
  const data = new type(4 * WIDTH * height).fill(type === Float32Array ? FREE : 0);
  if (before !== undefined) data.set(before.subarray(0, data.length));
  const precision = type === Float32Array ? THREE.FloatType : THREE.HalfFloatType;
  const result = new THREE.DataTexture(data, WIDTH, height, THREE.RGBAFormat, precision);
  result.userData.whole = true;
  result.onUpdate = () => (result.userData.whole = false);
  result.needsUpdate = true;
  return result;
}

/** Copy rows into a texture and mark the lines that they touch. */
function scatter(
  texture: THREE.DataTexture,
  rows: Uint32Array,
  values: Float32Array | Uint16Array,
  size: number,
  whole: boolean,
): void {
  const data = texture.image.data as Float32Array;
  const line = 4 * WIDTH;
  const touched = new Uint8Array(texture.image.height);
  for (let k = 0; k < rows.length; k++) {
    const to = size * rows[k];
    for (let i = 0, from = size * k; i < size; i++) data[to + i] = values[from + i];
    touched[Math.floor(to / line)] = 1;
    touched[Math.floor((to + size - 1) / line)] = 1;
  }
  // Without ranges, the whole texture is copied. A copy that is still due must not be narrowed by later ranges.
  texture.userData.whole ||= whole;
  texture.clearUpdateRanges();
  if (!texture.userData.whole) touched.forEach((flag, y) => flag === 1 && texture.addUpdateRange(y * line, line));
  texture.needsUpdate = true;
}
