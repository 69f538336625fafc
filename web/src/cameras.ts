/** The recorded cameras in the terms of three.js. */

import * as THREE from "three";
import type { CameraFields } from "./stream";

/** Axis of a camera in world coordinates: right, down or ahead. */
export function axisOf({ viewmat }: CameraFields, i: number): THREE.Vector3 {
  return new THREE.Vector3(viewmat[i][0], viewmat[i][1], viewmat[i][2]);
}

export function positionOf(camera: CameraFields): THREE.Vector3 {
  const position = new THREE.Vector3();
  for (let i = 0; i < 3; i++) position.addScaledVector(axisOf(camera, i), -camera.viewmat[i][3]);
  return position;
}

/** Camera to world, with the axes of a camera of three.js. */
export function poseOf(camera: CameraFields): THREE.Matrix4 {
  const [right, down, ahead] = [0, 1, 2].map((i) => axisOf(camera, i));
  return new THREE.Matrix4().makeBasis(right, down.negate(), ahead.negate()).setPosition(positionOf(camera));
}

/** Vertical field of view, degrees, with which an image of an aspect ratio shows the whole image of a camera. */
export function fovOf({ K, width, height }: CameraFields, aspect: number): number {
  return THREE.MathUtils.radToDeg(2 * Math.atan(Math.max(height, width / aspect) / (2 * K[1][1])));
}

/** Give a camera of three.js the field of view and the principal point of a recorded one, around its whole image. */
export function focus(camera: THREE.PerspectiveCamera, recorded: CameraFields): void {
  const { K, width, height } = recorded;
  const { aspect } = camera;
  const x = (width / 2 - K[0][2]) / Math.max(width, height * aspect);
  const y = (height / 2 - K[1][2]) / Math.max(height, width / aspect);
  camera.fov = fovOf(recorded, aspect);
  camera.setViewOffset(1, 1, x, y, 1, 1); // which changes the aspect ratio
  camera.aspect = aspect;
  camera.updateProjectionMatrix();
}

/** Mean up direction of the cameras; that of the first one where they cancel out. */
function upDirection(cameras: CameraFields[]): THREE.Vector3 {
  const up = new THREE.Vector3();
  for (const camera of cameras) up.sub(axisOf(camera, 1));
  return (up.length() > 0.1 * cameras.length ? up : axisOf(cameras[0], 1).negate()).normalize();
}

/**
 * Up direction of a turntable that starts from a camera: that of the cameras, tilted sideways as far as this one is, so
 * that looking along its axis shows its image.
 */
export function turntableUp(camera: CameraFields, cameras: CameraFields[]): THREE.Vector3 {
  const up = upDirection(cameras).projectOnPlane(axisOf(camera, 0)).normalize();
  const own = axisOf(camera, 1).negate();
  return up.dot(own) < 0.1 ? own : up;
}

/** Rotation from world to y up, as `gltf_axes` in morgs_mi/extras/exports/axes.py. */
export function upright(cameras: CameraFields[]): THREE.Quaternion {
  const y = upDirection(cameras);
  const [right, ahead] = [0, 2].map((i) => axisOf(cameras[0], i).projectOnPlane(y));
  const x = (right.length() < 0.5 ? ahead : right).normalize();
  const axes = new THREE.Matrix4().makeBasis(x, y, x.clone().cross(y));
  return new THREE.Quaternion().setFromRotationMatrix(axes.invert());
}
