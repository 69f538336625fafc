/** Drawing: a mesh, which Spark sorts and blends, and the modes of the page. */

import { dyno, SparkRenderer } from "@sparkjsdev/spark";
import * as THREE from "three";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";
import { CONFIDENCE_COLORS } from "./colors";
import { background, quantile, rendererOptions, type Seen, StreamMesh, TEXELS } from "./mesh";
import type { Update } from "./update";
import type { Rectangle } from "./view";

export type Mode = "color" | "motion" | "confidence" | "depth";
export const MODES: Mode[] = ["color", "motion", "confidence", "depth"];
/** What is behind the Gaussians: the colour of the fit, or another one. */
export const GROUNDS = ["of the fit", "black", "grey", "white", "checker"];
/** Width of a square of the checker, pixels of the page. */
const SQUARE = 16;

/** Motion, in units of full saturation, is blended with this added, because Spark clips negative values. */
const SHIFT = 2;

// `_screen_motion` in morgs_mi/render/projection.py.
const MOTION = /* glsl */ `
// First-order projection, x to the right and y down, in units of \`saturation\`.
vec2 motionSeenFrom(mat4 view, vec3 mean, vec3 displacement, float saturation) {
  vec3 p = (view * vec4(mean, 1.0)).xyz, m = mat3(view) * displacement;
  vec2 motion = (m.xy + p.xy / -p.z * m.z) / -p.z / saturation;
  return clamp(vec2(motion.x, -motion.y), -${SHIFT}.0, ${SHIFT}.0) + ${SHIFT}.0;
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
    vec2 m = blended.a > 0.0 ? blended.rg / blended.a - ${SHIFT}.0 : vec2(0.0);
    float sixth = fract(atan(m.y, m.x) / 6.283185307179586) * 6.0;
    vec3 hue = clamp(abs(mod(sixth + vec3(0.0, 4.0, 2.0), 6.0) - 3.0) - 1.0, 0.0, 1.0);
    gl_FragColor = vec4(mix(vec3(clamp(blended.b, 0.0, 1.0)), hue, min(length(m), 1.0)), 1.0);
  } else {
    float value = mode == 2 || blended.a == 0.0 ? blended.r : blended.r / blended.a;
    float texels = float(textureSize(colors, 0).x);
    float u = (clamp(value, 0.0, 1.0) * (texels - 1.0) + 0.5) / texels;
    gl_FragColor = vec4(texture2D(colors, vec2(u, 0.5)).rgb, 1.0);
  }
}
`;

const POST_VERTEX = "varying vec2 at; void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }";

const CHECKER = new THREE.DataTexture(new Uint8Array([102, 102, 102, 255, 153, 153, 153, 255, 153, 153, 153, 255, 102, 102, 102, 255]), 2, 2);
CHECKER.wrapS = CHECKER.wrapT = THREE.RepeatWrapping;
CHECKER.colorSpace = THREE.SRGBColorSpace;
CHECKER.needsUpdate = true;

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
    depths: new dyno.DynoVec2({ key: "depths", value: new THREE.Vector2(1, 2) }),
  };
  private readonly target = new THREE.WebGLRenderTarget(1, 1, { type: THREE.HalfFloatType, depthBuffer: false });
  private readonly post: FullScreenQuad;
  private changed = true;
  /** Colour behind all Gaussians in the fit. */
  private readonly background: THREE.Color;
  /** Colour or pattern behind them on the page. */
  private behind: THREE.Color | THREE.Texture;
  /** Image behind them in the view of the selected camera, and whether it is shown. */
  private backdrop: THREE.Texture | null = null;
  private shows = false;
  /** Stops by which the colours are brightened before they are clipped at white. */
  private stops = 0;

  constructor(canvas: HTMLCanvasElement, metadata: Record<string, unknown>, unit: number) {
    // Colours are display-referred, and blended as they are.
    THREE.ColorManagement.workingColorSpace = THREE.SRGBColorSpace;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, depth: false });
    this.background = background(metadata);
    this.behind = this.background;
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
    CHECKER.repeat.set(width / (2 * SQUARE), height / (2 * SQUARE));
    this.changed = true;
  }

  setMode(mode: Mode): void {
    this.mode = mode;
    this.uniforms.mode.value = MODES.indexOf(mode);
    this.mesh.updateVersion();
    this.changed = true;
  }

  /** Use an image, PNG in base64, behind the Gaussians of a view; `showBackdrop` shows it. */
  loadBackdrop(png: string | undefined): void {
    this.backdrop?.dispose();
    const loaded = () => (this.changed = true);
    this.backdrop = png === undefined ? null : new THREE.TextureLoader().load(`data:image/png;base64,${png}`, loaded);
    if (this.backdrop !== null) this.backdrop.colorSpace = THREE.SRGBColorSpace; // three.js encodes what is behind
    this.showBackdrop(null);
  }

  /** Show the image behind the Gaussians in a rectangle of the page, or not. */
  showBackdrop(place: Rectangle | null): void {
    this.shows = place !== null;
    if (place === null || this.backdrop === null) return;
    const page = this.renderer.getSize(new THREE.Vector2());
    this.backdrop.repeat.set(page.x / place.width, page.y / place.height);
    this.backdrop.offset.set(-place.x / place.width, 1 - (page.y - place.y) / place.height);
  }

  /** Show what is behind the Gaussians: one of GROUNDS. */
  setGround(ground: string): void {
    const colors: Record<string, THREE.Color | THREE.Texture> = {
      black: new THREE.Color(0x000000),
      grey: new THREE.Color(0x808080),
      white: new THREE.Color(0xffffff),
      checker: CHECKER,
    };
    this.behind = colors[ground] ?? this.background;
    this.changed = true;
  }

  /** Scale the colours of depth to what a camera sees, and return the nearest and the farthest depth, page units. */
  scaleDepth(camera: THREE.PerspectiveCamera): number[] {
    const depths = this.mesh.seen(camera).map(({ depth }) => depth);
    const [near, far] = [0.02, 0.98].map((fraction) => quantile(depths, fraction) ?? 1);
    this.uniforms.depths.value.set(1 / near, 1 / far);
    this.mesh.updateVersion();
    return [near, far];
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
    if (this.mode === "motion" || this.mode === "depth") this.mesh.updateVersion();
    this.changed = true;
  }

  /** Draw now, so that the canvas can be read. */
  repaint(camera: THREE.PerspectiveCamera): void {
    this.changed = true;
    this.draw(camera);
  }

  /** Draw if anything has changed. */
  draw(camera: THREE.PerspectiveCamera): void {
    if (!this.changed) return;
    this.changed = false;
    const colored = this.displayedMode() === "color";
    const image = this.shows && this.behind === this.background ? this.backdrop : null;
    this.scene.background = colored ? (image ?? this.behind) : null;
    this.renderer.setClearColor(0x000000, colored ? 1 : 0); // else the alpha channel is the sum of the weights
    const direct = this.stops === 0 && this.mode === "color" && colored;
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
    const { sorting, sortDirty, orderingTexture, updateTimeoutId } = this.spark;
    const sorted = orderingTexture !== null && !sorting && !sortDirty && updateTimeoutId === -1;
    return sorted && !this.changed && this.shown === this.mode;
  }

  seen(camera: THREE.PerspectiveCamera): Seen[] {
    return this.mesh.seen(camera);
  }

  surface(camera: THREE.PerspectiveCamera, x: number, y: number): THREE.Vector3 | null {
    return this.mesh.surface(camera, x, y);
  }

  /** Return the modifier that replaces colours by what a mode shows. */
  private recoloring() {
    const { geometry } = this.mesh.textures.uniforms;
    return dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
      const recolored = new dyno.Dyno({
        inTypes: { gsplat: dyno.Gsplat, geometry: "sampler2D", mode: "int", view: "mat4", saturation: "float", depths: "vec2" },
        outTypes: { gsplat: dyno.Gsplat },
        inputs: { gsplat, geometry, ...this.uniforms },
        globals: () => [dyno.defineGsplat, TEXELS, MOTION],
        statements: ({ inputs: i, outputs: { gsplat } }) => dyno.unindentLines(`
          ${gsplat} = ${i.gsplat};
          int row = 4 * ${gsplat}.index;
          if (${i.mode} == 1) {
            vec3 displacement = texelOf(${i.geometry}, row + 3).xyz;
            float grey = dot(min(${gsplat}.rgba.rgb, 1.0), vec3(0.299, 0.587, 0.114));
            ${gsplat}.rgba.rgb = vec3(motionSeenFrom(${i.view}, ${gsplat}.center, displacement, ${i.saturation}), grey);
          } else if (${i.mode} == 3) {
            float nearness = -1.0 / (${i.view} * vec4(${gsplat}.center, 1.0)).z;
            ${gsplat}.rgba.rgb = vec3(clamp((nearness - ${i.depths}.y) / max(${i.depths}.x - ${i.depths}.y, 1e-9), 0.0, 1.0));
          } else if (${i.mode} == 2) {
            ${gsplat}.rgba.rgb = vec3(sigmoid(texelOf(${i.geometry}, row + 2).w));
          }
        `),
      });
      return { gsplat: recolored.outputs.gsplat };
    });
  }
}
