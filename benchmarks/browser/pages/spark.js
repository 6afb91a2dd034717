import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";

const SETTLING = 40; // animation frames in which it sorts

export async function make({ canvas, splats, background, eps2d, width, height }) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
  renderer.setSize(width, height, false);
  renderer.setClearColor(new THREE.Color().setRGB(...background, THREE.SRGBColorSpace));
  const scene = new THREE.Scene();
  const constants = { preBlurAmount: eps2d, blurAmount: 0, sortRadial: false, maxStdDev: 3.33, minAlpha: 1 / 255 };
  scene.add(new SparkRenderer({ renderer, ...constants }));
  const mesh = new SplatMesh({ url: splats });
  scene.add(mesh);
  await mesh.initialized;
  const view = new THREE.PerspectiveCamera();
  view.matrixAutoUpdate = false;
  const draw = () => renderer.render(scene, view);
  const show = (camera) => {
    view.fov = 2 * THREE.MathUtils.RAD2DEG * Math.atan(height / 2 / camera.fy);
    Object.assign(view, { aspect: width / height, near: 0.01, far: 1000 });
    view.updateProjectionMatrix();
    view.matrix.set(...camera.camera_to_world.flatMap((row) => [row[0], -row[1], -row[2], row[3]]));
    view.matrix.decompose(view.position, view.quaternion, view.scale);
    view.matrixWorldNeedsUpdate = true;
    requestAnimationFrame(draw);
  };
  const settled = async () => {
    for (let k = 0; k < SETTLING; k += 1) await new Promise((done) => requestAnimationFrame(() => done(draw())));
  };
  return { show, settled };
}
