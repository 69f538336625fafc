/** Drawing: Gaussians in textures, which Spark sorts and blends. */

import { dyno, SparkRenderer, SplatGenerator } from "@sparkjsdev/spark";
import * as THREE from "three";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";
import { CONFIDENCE_COLORS } from "./colors";
import { COEFFICIENT, FREE, GEOMETRY, OPACITY, type Update } from "./rows";

export type Mode = "color" | "motion" | "confidence";
export const MODES: Mode[] = ["color", "motion", "confidence"];

/** Texels of a line of the textures. */
const WIDTH = 2048;
/** Motion, in units of full saturation, is blended with this added, because Spark clips negative values. */
const SHIFT = 2;

/** The renderer's cut-offs, as RenderConfig has them. */
export interface Cutoffs {
  eps2d: number;
  alpha_min: number;
}

// The colours of `_colors` and `_screen_motion` in morgs_mi/render/projection.py.
const FUNCTIONS = /* glsl */ `
vec4 texelOf(sampler2D rows, int i) {
  return texelFetch(rows, ivec2(i % ${WIDTH}, i / ${WIDTH}), 0);
}

float sigmoid(float x) {
  return 1.0 / (1.0 + exp(-x));
}

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

// First-order projection, x to the right and y down, in units of \`saturation\`.
vec3 motionSeenFrom(mat4 view, vec3 mean, vec3 displacement, float saturation) {
  vec3 p = (view * vec4(mean, 1.0)).xyz, m = mat3(view) * displacement;
  vec2 motion = (m.xy + p.xy / -p.z * m.z) / -p.z / saturation;
  return vec3(clamp(vec2(motion.x, -motion.y), -${SHIFT}.0, ${SHIFT}.0) + ${SHIFT}.0, 1.0);
}
`;

const POST = /* glsl */ `
uniform sampler2D image;
uniform sampler2D colors;
uniform int mode;
varying vec2 at;

void main() {
  vec4 blended = texture2D(image, at);
  if (mode == 0) {
    gl_FragColor = vec4(blended.rgb, 1.0);
  } else if (mode == 1) {
    vec2 m = blended.b > 0.0 ? blended.rg / blended.b - ${SHIFT}.0 : vec2(0.0);
    float sixth = fract(atan(m.y, m.x) / 6.283185307179586) * 6.0;
    vec3 hue = clamp(abs(mod(sixth + vec3(0.0, 4.0, 2.0), 6.0) - 3.0) - 1.0, 0.0, 1.0);
    gl_FragColor = vec4(mix(vec3(1.0), hue, min(length(m), 1.0)), 1.0);
  } else {
    float texels = float(textureSize(colors, 0).x);
    float u = (clamp(blended.r, 0.0, 1.0) * (texels - 1.0) + 0.5) / texels;
    gl_FragColor = vec4(texture2D(colors, vec2(u, 0.5)).rgb, 1.0);
  }
}
`;

const POST_VERTEX = "varying vec2 at; void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }";

export class Splats {
  readonly renderer: THREE.WebGLRenderer;
  readonly spark: SparkRenderer;
  mode: Mode = "color";
  /** Mode of the values that are displayed; after a jump, those before are until the new ones are sorted. */
  shown: Mode = "color";
  /** Mode of the values in each of Spark's buffers. */
  private readonly modes = new WeakMap<object, Mode>();
  private readonly scene = new THREE.Scene();
  private readonly generator: SplatGenerator;
  private readonly uniforms;
  private readonly target = new THREE.WebGLRenderTarget(1, 1, { type: THREE.HalfFloatType, depthBuffer: false });
  private readonly post: FullScreenQuad;
  private geometry = texture(1, Float32Array);
  private sh = texture(1, Uint16Array);
  private capacity = 0;
  private degree = 0;
  private changed = true;

  constructor(canvas: HTMLCanvasElement, cutoffs: Cutoffs, private readonly unit: number) {
    // Colours are display-referred, and blended as they are.
    THREE.ColorManagement.workingColorSpace = THREE.SRGBColorSpace;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, depth: false });
    this.renderer.setClearColor(0x000000, 1);
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      accumExtSplats: true,
      preBlurAmount: cutoffs.eps2d,
      blurAmount: 0,
      minAlpha: cutoffs.alpha_min,
      maxStdDev: Math.sqrt(-2 * Math.log(cutoffs.alpha_min)),
      maxPixelRadius: 1e5,
      sortRadial: false,
      enableLod: false,
      depthTest: false,
      onDirty: () => (this.changed = true),
    });
    const uniforms = {
      geometry: new dyno.DynoSampler2D({ key: "geometry", value: this.geometry }),
      sh: new dyno.DynoSampler2D({ key: "sh", value: this.sh }),
      mode: new dyno.DynoInt({ value: 0 }),
      degree: new dyno.DynoInt({ value: 0 }),
      unit: new dyno.DynoFloat({ value: unit }),
      eye: new dyno.DynoVec3({ value: new THREE.Vector3() }),
      view: new dyno.DynoMat4({ value: new THREE.Matrix4() }),
      saturation: new dyno.DynoFloat({ value: 1 }),
    };
    this.uniforms = uniforms;
    this.generator = new SplatGenerator({
      generator: dyno.dynoBlock({ index: "int" }, { gsplat: dyno.Gsplat }, ({ index }) => {
        const read = new dyno.Dyno({
          inTypes: {
            index: "int",
            geometry: "sampler2D",
            sh: "sampler2D",
            mode: "int",
            degree: "int",
            unit: "float",
            eye: "vec3",
            view: "mat4",
            saturation: "float",
          },
          outTypes: { gsplat: dyno.Gsplat },
          inputs: { index, ...uniforms },
          globals: () => [dyno.defineGsplat, FUNCTIONS],
          statements: ({ inputs: i, outputs: { gsplat } }) => dyno.unindentLines(`
            vec4 place = texelOf(${i.geometry}, 4 * ${i.index});
            vec4 scales = texelOf(${i.geometry}, 4 * ${i.index} + 2);
            vec3 displacement = texelOf(${i.geometry}, 4 * ${i.index} + 3).xyz;
            ${gsplat}.flags = place.w > ${FREE}.0 ? GSPLAT_FLAG_ACTIVE : 0u;
            ${gsplat}.index = ${i.index};
            ${gsplat}.center = place.xyz * ${i.unit};
            ${gsplat}.scales = exp(scales.xyz) * ${i.unit};
            ${gsplat}.quaternion = texelOf(${i.geometry}, 4 * ${i.index} + 1);
            vec3 color = ${i.mode} == 0
              ? colorSeenFrom(${i.sh}, ${i.index}, ${i.degree}, normalize(place.xyz * ${i.unit} - ${i.eye}))
              : ${i.mode} == 1
              ? motionSeenFrom(${i.view}, place.xyz * ${i.unit}, displacement * ${i.unit}, ${i.saturation})
              : vec3(sigmoid(scales.w));
            ${gsplat}.rgba = vec4(color, sigmoid(place.w));
          `),
        });
        return { gsplat: read.outputs.gsplat };
      }),
    });
    this.scene.add(this.spark, this.generator);

    const colors = new THREE.DataTexture(CONFIDENCE_COLORS, CONFIDENCE_COLORS.length / 4, 1);
    colors.minFilter = colors.magFilter = THREE.LinearFilter;
    colors.needsUpdate = true;
    const values = { image: { value: this.target.texture }, colors: { value: colors }, mode: { value: 0 } };
    this.post = new FullScreenQuad(
      new THREE.ShaderMaterial({ uniforms: values, vertexShader: POST_VERTEX, fragmentShader: POST }),
    );
  }

  /** Write an update into the textures. */
  apply(update: Update): void {
    const K = (update.degree + 1) ** 2;
    if (update.capacity > this.capacity || update.degree !== this.degree) this.allocate(update.capacity, update.degree);
    if (update.reset) (this.geometry.image.data as Float32Array).fill(FREE);
    scatter(this.geometry, update.rows, update.geometry, GEOMETRY, update.reset);
    scatter(this.sh, update.rows, update.sh, COEFFICIENT * K, update.reset);
    // After a reset, the order of the frame before is of no use.
    if (update.reset) this.generator.updateMappingVersion();
    else this.generator.updateVersion();
    this.changed = true;
  }

  resize(width: number, height: number, ratio: number): void {
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.target.setSize(Math.round(width * ratio), Math.round(height * ratio));
    this.changed = true;
  }

  setMode(mode: Mode): void {
    this.mode = mode;
    this.uniforms.mode.value = MODES.indexOf(mode);
    this.generator.updateVersion();
    this.changed = true;
  }

  /** Follow the camera; `saturation` is the tangent of the motion that is fully saturated. */
  setView(camera: THREE.PerspectiveCamera, saturation: number): void {
    camera.updateMatrixWorld();
    this.uniforms.eye.value.copy(camera.position);
    this.uniforms.view.value.copy(camera.matrixWorldInverse);
    this.uniforms.saturation.value = saturation;
    if (this.mode === "motion" || (this.mode === "color" && this.degree > 0)) this.generator.updateVersion();
    this.changed = true;
  }

  /** Draw if anything has changed. */
  draw(camera: THREE.PerspectiveCamera): void {
    if (!this.changed) return;
    this.changed = false;
    const direct = this.mode === "color" && this.displayedMode() === "color";
    this.renderer.setRenderTarget(direct ? null : this.target);
    this.renderer.render(this.scene, camera);
    this.renderer.setRenderTarget(null);
    this.shown = this.displayedMode();
    if (direct) return;
    (this.post.material as THREE.ShaderMaterial).uniforms.mode.value = MODES.indexOf(this.shown);
    this.post.render(this.renderer);
  }

  /** Return the mode of the values that Spark displays. */
  private displayedMode(): Mode {
    const { current, display } = this.spark;
    if (current.mapping[0]?.version === this.generator.version) this.modes.set(current, this.mode);
    return this.modes.get(display) ?? this.mode;
  }

  /** Whether the image shows all that was applied, in the right order. */
  get settled(): boolean {
    return !this.changed && !this.spark.sorting && !this.spark.sortDirty && this.shown === this.mode;
  }

  private allocate(capacity: number, degree: number): void {
    const grown = Math.ceil(1.1 * capacity);
    const [geometry, sh] = [this.geometry, this.sh];
    const sameDegree = degree === this.degree;
    this.geometry = texture(4 * grown, Float32Array, geometry.image.data as Float32Array);
    this.sh = texture((degree + 1) ** 2 * grown, Uint16Array, sameDegree ? (sh.image.data as Uint16Array) : undefined);
    geometry.dispose();
    sh.dispose();
    [this.capacity, this.degree] = [grown, degree];
    this.uniforms.geometry.value = this.geometry;
    this.uniforms.sh.value = this.sh;
    this.uniforms.degree.value = degree;
    this.generator.numSplats = grown;
  }

  /** Median depth of the Gaussians in front of a camera, in the page's units. */
  medianDepth(camera: THREE.PerspectiveCamera): number {
    const data = this.geometry.image.data as Float32Array;
    const depths: number[] = [];
    const point = new THREE.Vector3();
    const stride = GEOMETRY * Math.max(1, Math.floor(this.capacity / 5000));
    for (let at = 0; at < GEOMETRY * this.capacity; at += stride) {
      if (data[at + OPACITY] < -2) continue;
      point.set(data[at], data[at + 1], data[at + 2]).multiplyScalar(this.unit).applyMatrix4(camera.matrixWorldInverse);
      const depth = -point.z;
      point.applyMatrix4(camera.projectionMatrix);
      if (depth > 0 && Math.abs(point.x) < 1 && Math.abs(point.y) < 1) depths.push(depth);
    }
    return depths.sort((a, b) => a - b)[depths.length >> 1] ?? 1;
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
