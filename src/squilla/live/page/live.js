// The live camera: what is watched, what comes back with every frame, and the wishes to the camera.

export class Live {
  constructor(parts) {
    Object.assign(this, parts);
    this.on = false;
  }

  open(about) {
    this.on = Boolean(about.live);
  }

  watch() {}

  frame() {}
}
