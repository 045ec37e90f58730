// The picture on its stage: zoom, pan, pins, regions, a cursor for those without a mouse.

const NEAR = 4; // screen pixels below which a press is a click, not a drag

/** Pixels to paint on, and the canvas that shows them. */
class Image {
  constructor() {
    this.canvas = document.createElement("canvas");
    this.pen = this.canvas.getContext("2d");
  }

  fill({ width, height }, paint) {
    if (this.canvas.width !== width || this.canvas.height !== height || !this.pixels) {
      Object.assign(this.canvas, { width, height });
      this.pixels = this.pen.createImageData(width, height);
      this.words = new Uint32Array(this.pixels.data.buffer);
    }
    paint(this.words);
    this.pen.putImageData(this.pixels, 0, 0);
  }
}

export class View {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {object} told - called back: `select(region)`, `hover(point|null)`, `zoomed()`.
   */
  constructor(canvas, told) {
    this.canvas = canvas;
    this.told = told;
    this.context = canvas.getContext("2d");
    this.image = new Image();
    this.part = new Image();
    this.window = null;
    this.rows = this.columns = 0;
    this.scale = 1;
    this.left = this.top = 0;
    this.fitted = true;
    this.panning = false;
    this.marks = [];
    this.cursor = null;
    this.fingers = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.listen();
  }

  /** Take the size of a cube, px; keeps zoom and place if it is the same as before. */
  measure(rows, columns) {
    if (rows === this.rows && columns === this.columns) return;
    Object.assign(this, { rows, columns, cursor: null, window: null });
    this.fit();
  }

  /** Let `paint(pixels)` fill the whole picture, and show it. */
  show(size, paint) {
    this.image.fill(size, paint);
    this.draw();
  }

  /** Let `paint(pixels)` fill a part that is shown more finely over the whole; null takes it away. */
  showPart(size, paint) {
    if (size) this.part.fill(size, paint);
    this.window = size?.window ?? null;
    if (size) this.draw();
  }

  /** Return the part of the picture that is on the stage: top, left, bottom, right. */
  visible() {
    const [top, left] = this.clamped(0, 0), [bottom, right] = this.clamped(this.width, this.height);
    return [top, left, bottom + 1, right + 1];
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = devicePixelRatio || 1;
    Object.assign(this, { width, height, ratio });
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    if (this.fitted) this.fit();
    else this.draw();
  }

  fit() {
    this.fitted = true;
    this.scale = Math.min(this.width / this.columns, this.height / this.rows) || 1;
    this.left = (this.width - this.columns * this.scale) / 2;
    this.top = (this.height - this.rows * this.scale) / 2;
    this.draw();
    this.told.zoomed();
  }

  /** Zoom by a factor about a place on the screen; by default the middle. */
  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const whole = Math.min(this.width / this.columns, this.height / this.rows);
    const scale = Math.min(Math.max(this.scale * factor, Math.min(whole, 1)), 64);
    this.left = x - (x - this.left) * scale / this.scale;
    this.top = y - (y - this.top) * scale / this.scale;
    this.scale = scale;
    this.fitted = Math.abs(scale / whole - 1) < 1e-3;
    this.keep();
  }

  pan(x, y) {
    this.left += x;
    this.top += y;
    this.fitted = false;
    this.keep();
  }

  /** Keep a part of the picture on the stage. */
  keep() {
    const hold = (at, size, room) => size <= room
      ? (room - size) / 2
      : Math.min(0, Math.max(room - size, at));
    this.left = hold(this.left, this.columns * this.scale, this.width);
    this.top = hold(this.top, this.rows * this.scale, this.height);
    this.draw();
    this.told.zoomed();
  }

  /** Return the picture's pixel at a place on the screen, or null. */
  pixel(x, y) {
    const row = Math.floor((y - this.top) / this.scale);
    const column = Math.floor((x - this.left) / this.scale);
    return row >= 0 && row < this.rows && column >= 0 && column < this.columns ? [row, column] : null;
  }

  clamped(x, y) {
    const limit = (value, most) => Math.min(Math.max(value, 0), most - 1);
    return [
      limit(Math.floor((y - this.top) / this.scale), this.rows),
      limit(Math.floor((x - this.left) / this.scale), this.columns),
    ];
  }

  draw() {
    const pen = this.context;
    if (!this.rows || !this.width) return;
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.imageSmoothingEnabled = this.scale < 1;
    pen.imageSmoothingQuality = "high";
    this.put(this.image, [0, 0, this.rows, this.columns]);
    if (this.window) this.put(this.part, this.window);
    for (const mark of this.marks) this.mark(mark);
    if (this.cursor && document.activeElement === this.canvas) this.cross(this.cursor);
    if (this.box) this.mark({ region: this.box, colour: "#fff" });
  }

  put({ canvas }, [top, left, bottom, right]) {
    const { scale } = this;
    this.context.drawImage(canvas, this.left + left * scale, this.top + top * scale, (right - left) * scale, (bottom - top) * scale);
  }

  /** Draw a point as a ring, a region as a frame, dark about light so that both show anywhere. */
  mark({ region: [top, left, bottom, right], colour, label, active }) {
    const pen = this.context, single = bottom - top === 1 && right - left === 1;
    const x = this.left + left * this.scale, y = this.top + top * this.scale;
    const wide = (right - left) * this.scale, high = (bottom - top) * this.scale;
    const outline = () => {
      pen.beginPath();
      if (single) pen.arc(x + wide / 2, y + high / 2, Math.max(7, this.scale * 0.75), 0, 7);
      else pen.rect(x, y, wide, high);
    };
    outline();
    pen.lineWidth = active ? 5.5 : 4.5;
    pen.strokeStyle = "rgb(0 0 0 / 55%)";
    pen.stroke();
    outline();
    pen.lineWidth = active ? 2.5 : 2;
    pen.strokeStyle = colour;
    pen.stroke();
    if (!label) return;
    const at = single ? [x + wide / 2 + 13, y + high / 2 - 11] : [x + wide, y];
    pen.beginPath();
    pen.arc(...at, 8, 0, 7);
    pen.fillStyle = colour;
    pen.fill();
    pen.fillStyle = "#fff";
    pen.font = "600 11px Inter, system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(label, at[0], at[1] + 0.5);
  }

  cross([row, column]) {
    const pen = this.context;
    const x = this.left + (column + 0.5) * this.scale, y = this.top + (row + 0.5) * this.scale;
    for (const [width, colour] of [[3, "rgb(0 0 0 / 55%)"], [1, "#fff"]]) {
      pen.lineWidth = width;
      pen.strokeStyle = colour;
      pen.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        pen.moveTo(x + 9 * dx, y + 9 * dy);
        pen.lineTo(x + 22 * dx, y + 22 * dy);
      }
      pen.stroke();
    }
  }

  // --- hands -----------------------------------------------------------------------------------

  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", (event) => this.release(event));
    canvas.addEventListener("pointerleave", () => this.told.hover(null));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 60) / 240),
        event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("focus", () => this.draw());
    canvas.addEventListener("blur", () => this.draw());
  }

  press(event) {
    if (!this.rows) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    const pans = this.panning || event.button > 0 || event.shiftKey;
    this.start = { x: event.offsetX, y: event.offsetY, pans, moved: false };
    if (this.fingers.size === 2) {
      this.start.pinch = true;
      this.box = null;
    }
  }

  move(event) {
    const { offsetX: x, offsetY: y } = event, before = this.fingers.get(event.pointerId);
    if (!before) {
      this.told.hover(this.pixel(x, y));
      return;
    }
    const span = () => {
      const [[ax, ay], [bx, by]] = this.fingers.values();
      return [Math.hypot(ax - bx, ay - by), (ax + bx) / 2, (ay + by) / 2];
    };
    const two = this.fingers.size === 2, old = two ? span() : null;
    this.fingers.set(event.pointerId, [x, y]);
    if (two) {
      const [length, middleX, middleY] = span();
      this.pan(middleX - old[1], middleY - old[2]);
      this.zoom(length / Math.max(old[0], 1), middleX, middleY);
      return;
    }
    if (this.start.pinch) return;
    this.start.moved ||= Math.hypot(x - this.start.x, y - this.start.y) > NEAR;
    if (!this.start.moved) return;
    if (this.start.pans) {
      this.canvas.classList.add("panning");
      this.pan(x - before[0], y - before[1]);
    } else {
      this.box = this.between(this.start, { x, y });
      this.told.hover(null);
      this.told.select(this.box);
      this.draw();
    }
  }

  release(event) {
    this.fingers.delete(event.pointerId);
    this.canvas.classList.remove("panning");
    if (!this.start || this.fingers.size) return;
    const { pinch, pans, moved } = this.start;
    const dragged = this.box;
    this.start = this.box = null;
    if (pinch || event.type === "pointercancel" || (pans && (moved || event.button > 0))) return;
    if (dragged) {
      this.told.select(dragged);
      return;
    }
    const point = this.pixel(event.offsetX, event.offsetY);
    if (point) this.choose(point);
  }

  between(from, to) {
    const [a, b] = this.clamped(from.x, from.y), [c, d] = this.clamped(to.x, to.y);
    return [Math.min(a, c), Math.min(b, d), Math.max(a, c) + 1, Math.max(b, d) + 1];
  }

  choose([row, column]) {
    this.cursor = [row, column];
    this.told.select([row, column, row + 1, column + 1]);
  }

  key(event) {
    const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
    if (!(event.key in step) || !this.rows) return;
    event.preventDefault();
    const far = event.shiftKey ? 10 : 1, [down, right] = step[event.key];
    const [row, column] = this.cursor ?? [this.rows >> 1, this.columns >> 1];
    this.choose([
      Math.min(Math.max(row + down * far, 0), this.rows - 1),
      Math.min(Math.max(column + right * far, 0), this.columns - 1),
    ]);
  }
}
