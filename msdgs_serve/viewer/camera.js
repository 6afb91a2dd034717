// An orbit camera with the angles of the service's `orbit`. Flying moves the target too.

import { add, cross, dot, length, scaled, unit } from "./vector.js";

const STEEPEST = 89;
const MIN_RADIUS = 1e-3; // of depth ranges, as a fraction of the scene's distance
const DEGREES = 180 / Math.PI;
const WIDEST = 170 / DEGREES; // field of view

export class Camera {
  /** `view` is `view` of GET /scenes/{name}. */
  constructor(view) {
    this.aspect = 1; // width / height of the image; set by the stage
    this.setView(view);
    this.reset();
  }

  /** Replace the scene's view, and keep the angles and the target. */
  setView(view) {
    this.view = view;
    this.up = unit(view.up);
    // azimuth 0 is the world axis most perpendicular to `up`, as in the service
    const tilts = this.up.map(Math.abs);
    const axis = [0, 0, 0];
    axis[tilts.indexOf(Math.min(...tilts))] = 1;
    this.level = unit(add(axis, this.up, -dot(axis, this.up)));
    this.side = cross(this.up, this.level);
  }

  reset() {
    this.azimuth = 30;
    this.elevation = 20;
    this.distance = this.view.distance;
    this.target = [...this.view.target];
    this.setLens();
    this.sceneCamera = null;
  }

  /** Set the vertical field of view in degrees, and width / height of what it is for; by default those of the view. */
  setLens({ fov = this.view.fov_y, proportion = this.view.width / this.view.height } = {}) {
    [this.fovY, this.proportion] = [fov, proportion];
  }

  /** What of the lens differs from the view's, for `setLens`. */
  get ownLens() {
    const { fov_y, width, height } = this.view;
    const [fov, proportion] = [short(this.fovY), short(this.proportion)];
    return { ...(fov !== short(fov_y) && { fov }), ...(proportion !== short(width / height) && { proportion }) };
  }

  /** Use the exact pose of a stored camera of the scene, until the camera is moved. */
  take(sceneCamera, index) {
    const columns = [0, 1, 2, 3].map((j) => sceneCamera.camera_to_world.slice(0, 3).map((row) => row[j]));
    const [, , forward, eye] = columns;
    const inFront = dot(add(this.view.target, eye, -1), forward);
    this.distance = Math.max(inFront, 0.1 * this.view.distance);
    this.target = add(eye, forward, this.distance);
    const rise = Math.min(Math.max(dot(forward, this.up), -1), 1); // rounding may exceed the range of a sine
    this.elevation = limited(-Math.asin(rise) * DEGREES);
    this.azimuth = Math.atan2(-dot(forward, this.side), -dot(forward, this.level)) * DEGREES;
    this.fovY = 2 * Math.atan(sceneCamera.height / (2 * sceneCamera.fy)) * DEGREES;
    this.proportion = sceneCamera.width / sceneCamera.height;
    this.sceneCamera = index;
  }

  /** Unit vector from the target to the camera. */
  get outwards() {
    const [a, e] = [this.azimuth / DEGREES, this.elevation / DEGREES];
    const level = add(scaled(this.level, Math.cos(a)), this.side, Math.sin(a));
    return add(scaled(level, Math.cos(e)), this.up, Math.sin(e));
  }

  get eye() {
    return add(this.target, this.outwards, this.distance);
  }

  /** Right, up and forward of the image in world space. */
  get axes() {
    const forward = scaled(this.outwards, -1);
    const right = unit(cross(forward, this.up));
    return { right, above: cross(right, forward), forward };
  }

  /** Orbit by angles in degrees. */
  orbit(azimuth, elevation) {
    this.sceneCamera = null;
    this.azimuth = (((this.azimuth + azimuth) % 360) + 360) % 360;
    this.elevation = limited(this.elevation + elevation);
  }

  /** Rotate the camera about its position, in degrees. */
  look(azimuth, elevation) {
    const eye = this.eye;
    this.orbit(azimuth, elevation);
    this.target = add(eye, this.outwards, -this.distance);
  }

  /** Pan to the right and up, in fractions of the image's height. */
  pan(right, above) {
    this.sceneCamera = null;
    const height = 2 * this.distance * this.half;
    this.target = add(add(this.target, this.axes.right, right * height), this.axes.above, above * height);
  }

  /** Multiply the distance from the target by `factor`. */
  zoom(factor) {
    this.sceneCamera = null;
    const all = this.view.distance;
    this.distance = Math.min(Math.max(this.distance * factor, 1e-3 * all), 1e3 * all);
  }

  /** Move along the image's axes, in fractions of the scene's distance. */
  fly(right, above, forward) {
    this.sceneCamera = null;
    const axes = this.axes;
    const step = this.view.distance;
    for (const [axis, amount] of [[axes.right, right], [axes.above, above], [axes.forward, forward]]) {
      this.target = add(this.target, axis, amount * step);
    }
  }

  /** Half the height of the image at distance 1; narrow images keep a square of the scene visible. */
  get half() {
    return Math.tan(this.fovY / DEGREES / 2) * Math.max(1, Math.min(this.proportion, 1) / this.aspect);
  }

  /** Return `camera` of a request. */
  get spec() {
    if (this.sceneCamera !== null) return { type: "scene", index: this.sceneCamera };
    return {
      type: "orbit",
      azimuth: short(this.azimuth),
      elevation: short(this.elevation),
      distance: short(this.distance, this.distance),
      target: this.target.map((x) => short(x, this.distance)),
      fov_y: short(Math.min(2 * Math.atan(this.half), WIDEST) * DEGREES),
    };
  }
}

/** Return the view as a pinhole camera, with the pose of `camera_to_world` [4 × 4] in OpenCV's axes and lengths in pixels. */
export function pinhole(camera, scene, { width, height }) {
  if (camera.sceneCamera !== null) {
    const stored = scene.cameras[camera.sceneCamera];
    const [x, y] = [width / stored.width, height / stored.height];
    const { fx, fy, cx, cy, camera_to_world } = stored;
    return { fx: x * fx, fy: y * fy, cx: x * cx, cy: y * cy, width, height, camera_to_world };
  }
  const { right, above, forward } = camera.axes;
  const { eye } = camera;
  const focal = height / 2 / Math.min(camera.half, Math.tan(WIDEST / 2));
  return {
    fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height,
    camera_to_world: [...[0, 1, 2].map((i) => [right[i], -above[i], forward[i], eye[i]]), [0, 0, 0, 1]],
  }; // prettier-ignore
}

/** Return a depth range of the scene that is stable while the camera moves; ignores a few distant Gaussians. */
export function depthRange(camera, bounds) {
  const [low, high] = bounds;
  const { distance } = camera.view;
  const radius = Math.min(Math.max(length(add(high, low, -1)) / 2, MIN_RADIUS * distance), distance / 2);
  const middle = dot(add(camera.view.target, camera.eye, -1), camera.axes.forward);
  const near = Math.max(middle - radius, 0);
  return [near, Math.max(middle, near) + radius].map((x) => short(x, radius));
}

const limited = (elevation) => Math.min(Math.max(elevation, -STEEPEST), STEEPEST);

/** Round a number to a readable length: 1e-5 of `size` or less, which is far below a pixel. */
export function short(x, size = 1) {
  return Number(x.toFixed(Math.min(Math.max(5 - Math.floor(Math.log10(size)), 0), 12)));
}
