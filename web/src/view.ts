/** The camera: the views of the rig, and orbiting from there. */

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { axisOf, fovOf, positionOf, turntableUp } from "./cameras";
import { quantile, type Seen } from "./mesh";
import type { CameraFields } from "./stream";

/**
 * Angle around the direction of each camera in which orbits are free. Views between cameras that are twice as far apart
 * are fair, and between cameras farther apart poor (morgs_mi/fit/forecast.py). A camera without such a neighbour has half
 * of it, because a fit of few views falls apart sooner.
 */
const REACH = THREE.MathUtils.degToRad(8);
/** Share of the angle beyond it by which a frame turns the view back. */
const PULL = 0.5;
/** Distance, in units of the page, and angle up to which the view is at a camera: rounding of the controls. */
const AT_CAMERA = 1e-4;

/** Share of the Gaussians of a file on each side that may lie outside of the first view, and the margin around the others. */
const OUTSIDE = 0.025;
const MARGIN = 1.15;
/** Share of the distance to what the view orbits around by which a key moves it. */
const STRIDE = 0.06;

/** A rectangle: of a camera's image in its pixels, or of the page. */
export interface Rectangle {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** Where the view is and what it orbits around, world units. */
export interface Place {
  position: number[];
  target: number[];
}

export class View {
  readonly camera = new THREE.PerspectiveCamera();
  /** Whether orbits are drawn back to the directions of the rig's cameras. */
  bounded = true;
  private controls: OrbitControls | null = null;
  private current: CameraFields;
  /** Pose of the view at the selected camera. */
  private readonly home = new THREE.Object3D();
  /** Part of the selected camera's image that fills the page; null: all of it. */
  private subject: Rectangle | null = null;
  /** Where things move in its image, horizontally, pixels. */
  private motion = 0;
  private size = { width: 1, height: 1 };
  /** Positions of the rig's cameras. */
  private readonly positions: THREE.Vector3[];

  /**
   * @param recorded whether the cameras were recorded; those around a file frame its Gaussians
   * @param crops whether the image of a recorded camera covers an upright page
   */
  constructor(
    private readonly cameras: CameraFields[],
    private readonly unit: number,
    private readonly element: HTMLElement,
    private readonly recorded: boolean,
    private readonly crops: boolean,
    private readonly onChange: () => void,
  ) {
    this.current = cameras[0];
    this.positions = cameras.map((camera) => positionOf(camera).multiplyScalar(unit));
  }

  /**
   * Show what a camera of the rig sees; orbits turn around the point on its axis at the median depth of the Gaussians,
   * which `seen` returns.
   */
  select(index: number, seen: (camera: THREE.PerspectiveCamera) => Seen[]): void {
    this.current = this.cameras[index];
    const { width, height } = this.current;
    this.subject = { x: 0, y: 0, width, height };
    this.motion = width / 2;
    const { camera, unit } = this;
    const ahead = axisOf(this.current, 2);
    camera.position.copy(positionOf(this.current)).multiplyScalar(unit);
    camera.near = this.current.near * unit;
    camera.far = 1e5;
    camera.up.copy(turntableUp(this.current, this.cameras));
    camera.lookAt(ahead.clone().add(camera.position));
    this.project();
    const places = seen(camera);
    this.compose(places);
    this.project();
    this.controls?.dispose();
    this.controls = new OrbitControls(camera, this.element);
    this.controls.target.copy(camera.position).addScaledVector(ahead, quantile(places.map(({ depth }) => depth)) ?? 1);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.15;
    this.controls.zoomSpeed = 0.7;
    this.controls.addEventListener("change", this.onChange);
    this.controls.update();
    this.home.position.copy(camera.position);
    this.home.quaternion.copy(camera.quaternion);
    this.onChange();
  }

  /** Frame the Gaussians of a file, or place the image of a recorded camera on an upright page. */
  private compose(places: Seen[]): void {
    const { x, y, width, height } = this.rectangle;
    this.subject = null;
    const toImage = (place: number, start: number, length: number, page: number) =>
      ((((place + 1) / 2) * page - start) / length);
    const xs = (some: Seen[]) =>
      some.map((place) => this.current.width * toImage(place.x, x, width, this.size.width));
    const ys = places.map((place) => this.current.height * toImage(-place.y, y, height, this.size.height));
    if (this.recorded) {
      this.motion = quantile(xs(places.filter(({ moves }) => moves))) ?? this.motion;
    } else if (places.length > 0) {
      const [left, right] = [OUTSIDE, 1 - OUTSIDE].map((fraction) => quantile(xs(places), fraction)!);
      const [top, bottom] = [OUTSIDE, 1 - OUTSIDE].map((fraction) => quantile(ys, fraction)!);
      const [w, h] = [MARGIN * (right - left), MARGIN * (bottom - top)];
      if (w > 0 && h > 0) this.subject = { x: (left + right - w) / 2, y: (top + bottom - h) / 2, width: w, height: h };
    }
  }

  /** The part of the camera's image that fills the page. */
  private get frame(): Rectangle {
    const { width: w, height: h } = this.current;
    if (this.subject !== null) return this.subject;
    const visible = (h * this.size.width) / this.size.height;
    if (!this.crops || this.size.width > this.size.height || visible > w) return { x: 0, y: 0, width: w, height: h };
    return { x: Math.max(0, Math.min(w - visible, this.motion - visible / 2)), y: 0, width: visible, height: h };
  }

  /** Where the camera's whole image lies on the page. */
  get rectangle(): Rectangle {
    const { frame, scale, size, current } = this;
    return {
      x: size.width / 2 - scale * (frame.x + frame.width / 2),
      y: size.height / 2 - scale * (frame.y + frame.height / 2),
      width: scale * current.width,
      height: scale * current.height,
    };
  }

  /** Where the view is. */
  get place(): Place {
    const [position, target] = [this.camera.position, this.controls!.target].map((point) =>
      point.clone().divideScalar(this.unit).toArray(),
    );
    return { position, target };
  }

  /** Look from a place in the upright direction of the selected camera. */
  look({ position, target }: Place): void {
    this.bounded = false;
    this.camera.position.fromArray(position).multiplyScalar(this.unit);
    this.orbit(new THREE.Vector3().fromArray(target).multiplyScalar(this.unit));
  }

  /** Orbit around a point, in units of the page. */
  orbit(target: THREE.Vector3): void {
    this.controls!.target.copy(target);
    this.controls!.update();
  }

  /** Move sideways, up and ahead by strides. */
  walk(right: number, up: number, ahead: number): void {
    if (this.controls === null) return;
    const { camera, controls } = this;
    const step = new THREE.Vector3(right, up, -ahead).applyQuaternion(camera.quaternion);
    step.multiplyScalar(STRIDE * camera.position.distanceTo(controls.target));
    camera.position.add(step);
    this.orbit(controls.target.clone().add(step));
  }

  /** Whether the view is the one of the selected camera. */
  get atCamera(): boolean {
    const { position, quaternion } = this.camera;
    const distance = position.distanceTo(this.home.position);
    return distance < AT_CAMERA && quaternion.angleTo(this.home.quaternion) < AT_CAMERA;
  }

  /** The view as a camera with an image of a size in pixels. */
  fields(width: number, height: number): CameraFields {
    const { K, near } = this.current;
    const { size, unit } = this;
    this.camera.updateMatrixWorld();
    const m = this.camera.matrixWorldInverse.elements;
    const [right, up, back] = [0, 1, 2].map((i) => [m[i], m[4 + i], m[8 + i], m[12 + i] / unit]);
    const flipped = (row: number[]) => row.map((value) => -value);
    const [x, y] = [width / size.width, height / size.height];
    const { scale } = this;
    const [cx, cy] = this.offset;
    // prettier-ignore
    return {
      name: "page",
      K: [
        [x * scale * K[0][0], 0, width / 2 + x * scale * cx],
        [0, y * scale * K[1][1], height / 2 + y * scale * cy],
        [0, 0, 1],
      ],
      viewmat: [right, flipped(up), flipped(back), [0, 0, 0, 1]],
      width, height, near,
    };
  }

  resize(width: number, height: number): void {
    this.size = { width, height };
    this.project();
    this.onChange();
  }

  /** Continue a movement that slows down, and draw an orbit back that has left the rig. */
  update(): void {
    if (this.controls === null) return;
    this.controls.update();
    if (this.bounded) this.drawBack(this.controls);
  }

  /** Turn towards the nearest camera of the rig, as seen from what the view orbits around, where it is too far away. */
  private drawBack(controls: OrbitControls): void {
    const { target } = controls;
    const offset = this.camera.position.clone().sub(target);
    const directions = this.positions.map((position) => position.clone().sub(target));
    const angles = directions.map((direction) => direction.angleTo(offset));
    const angle = Math.min(...angles);
    const nearest = directions[angles.indexOf(angle)];
    const around = directions.filter((direction) => direction.angleTo(nearest) < 2 * REACH); // itself included
    const beyond = angle - (around.length > 1 ? REACH : REACH / 2);
    if (beyond < 1e-3) return;
    offset.applyAxisAngle(offset.clone().cross(nearest).normalize(), PULL * beyond);
    this.camera.position.copy(target).add(offset);
    controls.update();
  }

  /** Turn by angles in radians, positive to the right and up. */
  turn(right: number, up: number): void {
    if (this.controls === null) return;
    const { camera } = this;
    const offset = camera.position.clone().sub(this.controls.target);
    offset.applyAxisAngle(camera.up, right);
    const axis = new THREE.Vector3().crossVectors(camera.up, offset).normalize();
    offset.applyAxisAngle(axis, -up);
    if (Math.abs(offset.clone().normalize().dot(camera.up)) < 0.99) {
      camera.position.copy(this.controls.target).add(offset);
      this.controls.update();
    }
  }

  zoom(factor: number): void {
    if (this.controls === null) return;
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
  }

  /** Tangent of an angle that a fraction of the image's width spans. */
  tangent(fraction: number): number {
    return (fraction * this.current.width) / this.current.K[0][0];
  }

  /** Pixels of the page per pixel of the camera's image. */
  private get scale(): number {
    return Math.min(this.size.width / this.frame.width, this.size.height / this.frame.height);
  }

  /** Principal point from the middle of what fills the page, pixels of the camera's image. */
  private get offset(): number[] {
    const { K } = this.current;
    const { x, y, width, height } = this.frame;
    return [K[0][2] - x - width / 2, K[1][2] - y - height / 2];
  }

  /** Fit the part of the camera's image into the page: all of it is visible, and more beside it. */
  private project(): void {
    const { K } = this.current;
    const { width, height } = this.size;
    const { camera, scale } = this;
    const [cx, cy] = this.offset;
    const { near, far } = camera;
    // prettier-ignore
    camera.projectionMatrix.set(
      (2 * K[0][0] * scale) / width, 0, (-2 * cx * scale) / width, 0,
      0, (2 * K[1][1] * scale) / height, (2 * cy * scale) / height, 0,
      0, 0, (near + far) / (near - far), (2 * far * near) / (near - far),
      0, 0, -1, 0,
    );
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    camera.fov = fovOf(this.current, width / height); // for the speed of panning
  }
}
