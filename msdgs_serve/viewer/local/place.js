// The user's world and the scene's own frame, x_world = scale · x + offset; cameras in both.

const NOWHERE = { scale: 1, offset: [0, 0, 0] };
const MARGIN = 0.15; // of the image's size, beyond which the Jacobian is clamped

/** Return metadata of a scene file with bounds and cameras in the world, as GET /scenes/{name} has them. */
export function inWorld(metadata) {
  const place = metadata.scene_to_world ?? NOWHERE;
  const toWorld = (point) => point.map((x, i) => place.scale * x + place.offset[i]);
  const moved = (matrix) => {
    const position = toWorld([0, 1, 2].map((i) => matrix[i][3]));
    return matrix.map((row, i) => (i < 3 ? [...row.slice(0, 3), position[i]] : row));
  };
  return {
    eps2d: 0.3,
    duration: null,
    ...metadata,
    scene_to_world: place,
    bounds: metadata.bounds.map(toWorld),
    cameras: metadata.cameras.map((each) => ({ ...each, camera_to_world: moved(each.camera_to_world) })),
  };
}

/** Return what the shaders need of a camera in the world, and of a depth range in its units. */
export function viewOf(camera, { scale, offset }, depthRange = [0, 1]) {
  const { fx, fy, cx, cy, width, height, camera_to_world: pose } = camera;
  const eye = [0, 1, 2].map((i) => (pose[i][3] - offset[i]) / scale);
  const rotation = [0, 1, 2].map((i) => [pose[0][i], pose[1][i], pose[2][i]]);
  const [marginX, marginY] = [(MARGIN * width) / fx, (MARGIN * height) / fy];
  const limits = [-cx / fx - marginX, -cy / fy - marginY, (width - cx) / fx + marginX, (height - cy) / fy + marginY];
  return { fx, fy, cx, cy, width, height, eye, rotation, limits, depths: depthRange.map((depth) => depth / scale) };
}
