// The camera: on a sphere around a target, with the angles of the service's `orbit`. Flying moves the target along.

import { add, cross, dot, length, scaled, unit } from "./vector.js";

const STEEPEST = 89;
const DEGREES = 180 / Math.PI;

export class Camera {
  /** `view` is that of GET /scenes/{name}. */
  constructor(view) {
    this.view = view;
    this.up = unit(view.up);
    this.aspect = 1; // of the image, width to height; the stage sets it
    // azimuth 0 lies along the world axis that is most level, as the service has it
    const tilts = this.up.map(Math.abs);
    const axis = [0, 0, 0];
    axis[tilts.indexOf(Math.min(...tilts))] = 1;
    this.level = unit(add(axis, this.up, -dot(axis, this.up)));
    this.side = cross(this.up, this.level);
    this.reset();
  }

  reset() {
    this.azimuth = 30;
    this.elevation = 20;
    this.distance = this.view.distance;
    this.target = [...this.view.target];
    this.fovY = this.view.fov_y;
    this.proportion = this.view.width / this.view.height;
    this.sceneCamera = null;
  }

  /** Stand where a camera of the scene stands: exactly there, until something is moved. */
  take(sceneCamera, index) {
    const columns = [0, 1, 2, 3].map((j) => sceneCamera.camera_to_world.slice(0, 3).map((row) => row[j]));
    const [, , forward, eye] = columns;
    const ahead = dot(add(this.view.target, eye, -1), forward);
    this.distance = Math.max(ahead, 0.1 * this.view.distance);
    this.target = add(eye, forward, this.distance);
    this.elevation = limited(-Math.asin(dot(forward, this.up)) * DEGREES);
    this.azimuth = Math.atan2(-dot(forward, this.side), -dot(forward, this.level)) * DEGREES;
    this.fovY = 2 * Math.atan(sceneCamera.height / (2 * sceneCamera.fy)) * DEGREES;
    this.proportion = sceneCamera.width / sceneCamera.height;
    this.sceneCamera = index;
  }

  /** From the target to the camera, of length 1. */
  get outwards() {
    const [a, e] = [this.azimuth / DEGREES, this.elevation / DEGREES];
    const level = add(scaled(this.level, Math.cos(a)), this.side, Math.sin(a));
    return add(scaled(level, Math.cos(e)), this.up, Math.sin(e));
  }

  get eye() {
    return add(this.target, this.outwards, this.distance);
  }

  /** Right, up and forward in the image, world. */
  get axes() {
    const forward = scaled(this.outwards, -1);
    const right = unit(cross(forward, this.up));
    return { right, above: cross(right, forward), forward };
  }

  /** Degrees. */
  orbit(azimuth, elevation) {
    this.sceneCamera = null;
    this.azimuth = (((this.azimuth + azimuth) % 360) + 360) % 360;
    this.elevation = limited(this.elevation + elevation);
  }

  /** Turn the head, in degrees; the eye stays where it is. */
  look(azimuth, elevation) {
    const eye = this.eye;
    this.orbit(azimuth, elevation);
    this.target = add(eye, this.outwards, -this.distance);
  }

  /** Parts of the image's height, to the right and up. */
  pan(right, above) {
    this.sceneCamera = null;
    const height = 2 * this.distance * this.half;
    this.target = add(add(this.target, this.axes.right, right * height), this.axes.above, above * height);
  }

  /** Farther from the target where `factor` is above 1. */
  zoom(factor) {
    this.sceneCamera = null;
    const all = this.view.distance;
    this.distance = Math.min(Math.max(this.distance * factor, 1e-3 * all), 1e3 * all);
  }

  /** Parts of the scene's distance, along the image's axes. */
  fly(right, above, forward) {
    this.sceneCamera = null;
    const axes = this.axes;
    const step = this.view.distance;
    for (const [axis, amount] of [[axes.right, right], [axes.above, above], [axes.forward, forward]]) {
      this.target = add(this.target, axis, amount * step);
    }
  }

  /** Half the height of the image at distance 1; in a narrow one a square of the scene stays visible. */
  get half() {
    return Math.tan(this.fovY / DEGREES / 2) * Math.max(1, Math.min(this.proportion, 1) / this.aspect);
  }

  /** As `camera` of a request. */
  get spec() {
    if (this.sceneCamera !== null) return { type: "scene", index: this.sceneCamera };
    return {
      type: "orbit",
      azimuth: short(this.azimuth),
      elevation: short(this.elevation),
      distance: short(this.distance, this.distance),
      target: this.target.map((x) => short(x, this.distance)),
      fov_y: short(Math.min(2 * Math.atan(this.half) * DEGREES, 170)),
    };
  }
}

/** Depths between which the scene lies, steady while the camera moves; a few Gaussians far out don't count. */
export function depthRange(camera, bounds) {
  const [low, high] = bounds;
  const radius = Math.min(length(add(high, low, -1)) / 2, camera.view.distance / 2);
  const middle = dot(add(camera.view.target, camera.eye, -1), camera.axes.forward);
  const near = Math.max(middle - radius, 0);
  return [near, Math.max(middle, near) + radius].map((x) => short(x, radius));
}

const limited = (elevation) => Math.min(Math.max(elevation, -STEEPEST), STEEPEST);

/** So many digits that a copied request can be read; far finer than a pixel at `size`, in scene units. */
export function short(x, size = 1) {
  return Number(x.toFixed(Math.min(Math.max(5 - Math.floor(Math.log10(size)), 0), 12)));
}
