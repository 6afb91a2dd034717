import * as pc from "playcanvas";

const SETTLING = 40; // animation frames in which it sorts

export async function make({ canvas, splats, background, width, height }) {
  const device = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
  const app = new pc.Application(canvas, { graphicsDevice: device });
  app.autoRender = false;
  app.setCanvasFillMode(pc.FILLMODE_NONE);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
  const asset = new pc.Asset("splats", "gsplat", { url: splats });
  await new Promise((resolve, reject) => {
    asset.once("load", resolve);
    asset.once("error", reject);
    app.assets.add(asset);
    app.assets.load(asset);
  });
  const entity = new pc.Entity("splats");
  entity.addComponent("gsplat", { asset });
  app.root.addChild(entity);
  const eye = new pc.Entity("camera");
  eye.addComponent("camera", {
    clearColor: new pc.Color(...background),
    nearClip: 0.01,
    farClip: 1000,
    toneMapping: pc.TONEMAP_NONE,
  });
  app.root.addChild(eye);
  app.start();
  const show = (camera) => {
    eye.camera.fov = 2 * pc.math.RAD_TO_DEG * Math.atan(height / 2 / camera.fy);
    const columns = [0, 1, 2, 3].map((k) => camera.camera_to_world.map((row) => (k === 1 || k === 2 ? -row[k] : row[k])));
    const pose = new pc.Mat4().set(columns.flat());
    eye.setPosition(pose.getTranslation());
    eye.setRotation(new pc.Quat().setFromMat4(pose));
    app.renderNextFrame = true;
  };
  const settled = async () => {
    for (let k = 0; k < SETTLING; k += 1) {
      app.renderNextFrame = true;
      await new Promise((done) => app.once("frameend", done));
    }
  };
  return { show, settled };
}
