/** The camera: the views of the rig, and orbiting from there. */

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { axisOf, fovOf, positionOf, turntableUp } from "./cameras";
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

export class View {
  readonly camera = new THREE.PerspectiveCamera();
  /** Whether orbits are drawn back to the directions of the rig's cameras. */
  bounded = true;
  private controls: OrbitControls | null = null;
  private current: CameraFields;
  /** Pose of the view at the selected camera. */
  private readonly home = new THREE.Object3D();
  private size = { width: 1, height: 1 };
  /** Positions of the rig's cameras. */
  private readonly positions: THREE.Vector3[];

  constructor(
    private readonly cameras: CameraFields[],
    private readonly unit: number,
    private readonly element: HTMLElement,
    private readonly onChange: () => void,
  ) {
    this.current = cameras[0];
    this.positions = cameras.map((camera) => positionOf(camera).multiplyScalar(unit));
  }

  /** Show what a camera of the rig sees; orbits turn around the point on its axis at a distance. */
  select(index: number, distance: (camera: THREE.PerspectiveCamera) => number): void {
    this.current = this.cameras[index];
    const { camera, unit } = this;
    const ahead = axisOf(this.current, 2);
    camera.position.copy(positionOf(this.current)).multiplyScalar(unit);
    camera.near = this.current.near * unit;
    camera.far = 1e5;
    camera.up.copy(turntableUp(this.current, this.cameras));
    camera.lookAt(ahead.clone().add(camera.position));
    this.project();
    this.controls?.dispose();
    this.controls = new OrbitControls(camera, this.element);
    this.controls.target.copy(camera.position).addScaledVector(ahead, distance(camera));
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.15;
    this.controls.zoomSpeed = 0.7;
    this.controls.addEventListener("change", this.onChange);
    this.controls.update();
    this.home.position.copy(camera.position);
    this.home.quaternion.copy(camera.quaternion);
    this.onChange();
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
    const [cx, cy] = [K[0][2] - this.current.width / 2, K[1][2] - this.current.height / 2];
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
    return Math.min(this.size.width / this.current.width, this.size.height / this.current.height);
  }

  /** Fit the camera's image into the page: the whole image is visible, and more beside it. */
  private project(): void {
    const { K, width: w, height: h } = this.current;
    const { width, height } = this.size;
    const { camera, scale } = this;
    const { near, far } = camera;
    // prettier-ignore
    camera.projectionMatrix.set(
      (2 * K[0][0] * scale) / width, 0, (-2 * (K[0][2] - w / 2) * scale) / width, 0,
      0, (2 * K[1][1] * scale) / height, (2 * (K[1][2] - h / 2) * scale) / height, 0,
      0, 0, (near + far) / (near - far), (2 * far * near) / (near - far),
      0, 0, -1, 0,
    );
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    camera.fov = fovOf(this.current, width / height); // for the speed of panning
  }
}
