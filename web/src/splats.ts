/** Drawing: a mesh, which Spark sorts and blends, and the modes of the page. */

import { dyno, SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";
import { CONFIDENCE_COLORS } from "./colors";
import { background, rendererOptions, StreamMesh, TEXELS } from "./mesh";
import type { Update } from "./update";

export type Mode = "color" | "motion" | "confidence";
export const MODES: Mode[] = ["color", "motion", "confidence"];

/** Motion, in units of full saturation, is blended with this added, because Spark clips negative values. */
const SHIFT = 2;

// `_screen_motion` in morgs_mi/render/projection.py.
const MOTION = /* glsl */ `
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
uniform float stops;
varying vec2 at;

// The transfer curve of morgs_mi/core/color_space.py.
vec3 decoded(vec3 y) {
  vec3 srgb = mix(y / 12.92, pow((max(y, 0.0) + 0.055) / 1.055, vec3(2.4)), step(0.04045, y));
  return mix(srgb, exp((max(y, 1.0) - 1.0) * 2.4 / 1.055), step(1.0, y));
}

vec3 encoded(vec3 x) {
  return mix(12.92 * x, 1.055 * pow(max(x, 0.0), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}

void main() {
  vec4 blended = texture2D(image, at);
  if (mode == 0) {
    gl_FragColor = vec4(encoded(min(exp2(stops) * decoded(blended.rgb), 1.0)), 1.0);
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
  private readonly mesh = new StreamMesh();
  private readonly uniforms = {
    mode: new dyno.DynoInt({ key: "mode", value: 0 }),
    view: new dyno.DynoMat4({ key: "view", value: new THREE.Matrix4() }),
    saturation: new dyno.DynoFloat({ key: "saturation", value: 1 }),
  };
  private readonly target = new THREE.WebGLRenderTarget(1, 1, { type: THREE.HalfFloatType, depthBuffer: false });
  private readonly post: FullScreenQuad;
  private changed = true;
  /** Colour behind all Gaussians. */
  private readonly background: THREE.Color;
  /** Stops by which the colours are brightened before they are clipped at white. */
  private stops = 0;

  constructor(canvas: HTMLCanvasElement, metadata: Record<string, unknown>, unit: number) {
    // Colours are display-referred, and blended as they are.
    THREE.ColorManagement.workingColorSpace = THREE.SRGBColorSpace;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, depth: false });
    this.background = background(metadata);
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      ...rendererOptions(metadata),
      enableLod: false,
      depthTest: false,
      onDirty: () => (this.changed = true),
    });
    this.mesh.scale.setScalar(unit);
    this.mesh.objectModifier = this.recoloring();
    this.scene.add(this.spark, this.mesh);

    const colors = new THREE.DataTexture(CONFIDENCE_COLORS, CONFIDENCE_COLORS.length / 4, 1);
    colors.minFilter = colors.magFilter = THREE.LinearFilter;
    colors.needsUpdate = true;
    const values = { image: { value: this.target.texture }, colors: { value: colors }, mode: { value: 0 }, stops: { value: 0 } };
    this.post = new FullScreenQuad(
      new THREE.ShaderMaterial({ uniforms: values, vertexShader: POST_VERTEX, fragmentShader: POST }),
    );
  }

  apply(update: Update): void {
    this.mesh.apply(update);
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
    this.mesh.updateVersion();
    this.changed = true;
  }

  /** Show the colours brighter by some stops. */
  expose(stops: number): void {
    this.stops += stops;
    (this.post.material as THREE.ShaderMaterial).uniforms.stops.value = this.stops;
    this.changed = true;
  }

  /** Follow the camera; `saturation` is the tangent of the motion that is fully saturated. */
  setView(camera: THREE.PerspectiveCamera, saturation: number): void {
    camera.updateMatrixWorld();
    this.uniforms.view.value.multiplyMatrices(camera.matrixWorldInverse, this.mesh.matrixWorld);
    this.uniforms.saturation.value = saturation;
    if (this.mode === "motion") this.mesh.updateVersion();
    this.changed = true;
  }

  /** Draw if anything has changed. */
  draw(camera: THREE.PerspectiveCamera): void {
    if (!this.changed) return;
    this.changed = false;
    this.renderer.setClearColor(this.displayedMode() === "color" ? this.background : 0x000000, 1);
    const direct = this.stops === 0 && this.mode === "color" && this.displayedMode() === "color";
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
    if (current.mapping[0]?.version === this.mesh.version) this.modes.set(current, this.mode);
    return this.modes.get(display) ?? this.mode;
  }

  /** Whether the image shows all that was applied, in the right order. */
  get settled(): boolean {
    return !this.changed && !this.spark.sorting && !this.spark.sortDirty && this.shown === this.mode;
  }

  medianDepth(camera: THREE.PerspectiveCamera): number {
    return this.mesh.medianDepth(camera);
  }

  /** Return the modifier that replaces colours by what a mode shows. */
  private recoloring() {
    const { geometry } = this.mesh.textures.uniforms;
    return dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
      const recolored = new dyno.Dyno({
        inTypes: { gsplat: dyno.Gsplat, geometry: "sampler2D", mode: "int", view: "mat4", saturation: "float" },
        outTypes: { gsplat: dyno.Gsplat },
        inputs: { gsplat, geometry, ...this.uniforms },
        globals: () => [dyno.defineGsplat, TEXELS, MOTION],
        statements: ({ inputs: i, outputs: { gsplat } }) => dyno.unindentLines(`
          ${gsplat} = ${i.gsplat};
          int row = 4 * ${gsplat}.index;
          if (${i.mode} == 1) {
            vec3 displacement = texelOf(${i.geometry}, row + 3).xyz;
            ${gsplat}.rgba.rgb = motionSeenFrom(${i.view}, ${gsplat}.center, displacement, ${i.saturation});
          } else if (${i.mode} == 2) {
            ${gsplat}.rgba.rgb = vec3(sigmoid(texelOf(${i.geometry}, row + 2).w));
          }
        `),
      });
      return { gsplat: recolored.outputs.gsplat };
    });
  }
}
