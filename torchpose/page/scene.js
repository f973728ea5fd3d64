"use strict";
// The 3-D view: ellipsoids and points drawn into a depth buffer, pixel by pixel, without WebGL, so that it looks the
// same on every machine. Coordinates are the left camera's (x right, y down, z forward), metres.

const FIELD = 1.15; // focal length over the view's shorter side
const MOST_PIXELS = 1.6e6; // of the depth buffer
const PALE = 0.3; // white in the body's colours, so that points of the same colour stand out
const NEARER = 0.03; // m by which a point counts as nearer than it is: half of them lie under the fitted surface
const LIGHT = [-0.42, -0.62, -0.66]; // towards the light, in the view's axes

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));

class Scene {
  constructor(canvas, colours, bones, boneColours, floor) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.buffer = document.createElement("canvas");
    this.colours = colours;
    this.bones = bones;
    this.boneColours = boneColours;
    this.floor = floor || [0, 0, 0]; // y = a + b x + c z
    this.hasFloor = Boolean(floor);
    // A level frame, columns of the view at rest: down is the floor's normal, forward as the camera looks.
    const [, b, c] = this.floor, down = unit([-b, 1, -c]);
    const forward = unit([0, 1, 2].map((i) => (i === 2) - down[2] * down[i]));
    this.level = [cross(down, forward), down, forward];
    this.layers = { body: true, points: true, skeleton: true };
    this.look = { yaw: -0.55, pitch: 0.16, distance: 4 };
    this.target = [0, 0, 3];
    this.extent = 1;
  }

  // Turn about, and stand back from, all of these points (x, y, z in a row), but for the outermost hundredth.
  frame(points) {
    if (!points.length) return;
    const middle = [], half = [];
    for (const axis of this.level) {
      const values = Float64Array.from({ length: points.length / 3 }, (_, i) => dot(axis, points.slice(3 * i, 3 * i + 3))).sort();
      const last = values.length - 1, low = values[Math.floor(0.005 * last)], high = values[Math.ceil(0.995 * last)];
      middle.push((low + high) / 2);
      half.push((high - low) / 2);
    }
    middle[1] -= 0.03; // heads reach further beyond their joint than feet
    this.target = [0, 1, 2].map((i) => this.level[0][i] * middle[0] + this.level[1][i] * middle[1] + this.level[2][i] * middle[2]);
    this.extent = Math.max(half[1] + 0.28, 0.75 * Math.hypot(half[0], half[2]), 0.5);
    this.look.distance = 2.25 * this.extent * FIELD + half[2] * 0.5;
  }

  // Rows: the view's right, down and forward.
  axes() {
    const { yaw, pitch } = this.look, [x, y, z] = this.level;
    const mix = (a, b, c) => [0, 1, 2].map((i) => a * x[i] + b * y[i] + c * z[i]);
    const forward = mix(Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch));
    const right = mix(Math.cos(yaw), 0, -Math.sin(yaw));
    return [right, cross(forward, right), forward];
  }

  toView(R, x, y, z) {
    const a = x - this.target[0], b = y - this.target[1], c = z - this.target[2];
    return [
      R[0][0] * a + R[0][1] * b + R[0][2] * c,
      R[1][0] * a + R[1][1] * b + R[1][2] * c,
      R[2][0] * a + R[2][1] * b + R[2][2] * c + this.look.distance,
    ];
  }

  // people: [{name, ellipsoids: [{centre, axes (three columns), radii}], joints: [[x, y, z] or null]}];
  // clouds: [{points: Float32Array, labels: Int8Array}]
  draw(people, clouds) {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.max(this.canvas.clientWidth, 2), height = Math.max(this.canvas.clientHeight, 2);
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const R = this.axes();
    const view = { width, height, focal: FIELD * Math.min(width, height), R };
    const context = this.context;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    this.drawFloor(view, this.layers.body ? people : []);
    this.drawSolid(view, ratio, this.layers.body ? people : [], this.layers.points ? clouds : []);
    if (this.layers.skeleton) for (const person of people) this.drawSkeleton(view, person.joints);
    for (const person of people) this.drawName(view, person);
    this.drawCompass(view);
  }

  pixel(view, p) {
    return [view.width / 2 + (view.focal * p[0]) / p[2], view.height / 2 + (view.focal * p[1]) / p[2]];
  }

  // A straight line, cut where it comes near the eye.
  line(view, start, end) {
    let a = this.toView(view.R, ...start), b = this.toView(view.R, ...end);
    const near = 0.1;
    if (a[2] < near && b[2] < near) return;
    if (a[2] < near || b[2] < near) {
      const share = (near - a[2]) / (b[2] - a[2]);
      const cut = [0, 1, 2].map((i) => a[i] + share * (b[i] - a[i]));
      if (a[2] < near) a = cut; else b = cut;
    }
    this.context.moveTo(...this.pixel(view, a));
    this.context.lineTo(...this.pixel(view, b));
  }

  drawFloor(view, people) {
    if (!this.hasFloor) return;
    const context = this.context, step = 0.5, [height, b, c] = this.floor;
    const onFloor = (x, z) => [x, height + b * x + c * z, z];
    const reach = Math.ceil((this.extent * 1.6) / step) * step;
    const x0 = Math.round(this.target[0] / step) * step, z0 = Math.round(this.target[2] / step) * step;
    context.lineWidth = 1;
    for (const whole of [false, true]) {
      context.beginPath();
      for (let d = -reach; d <= reach + 1e-6; d += step) {
        if ((Math.abs((x0 + d) % 1) < 1e-6) === whole) this.line(view, onFloor(x0 + d, z0 - reach), onFloor(x0 + d, z0 + reach));
        if ((Math.abs((z0 + d) % 1) < 1e-6) === whole) this.line(view, onFloor(x0 - reach, z0 + d), onFloor(x0 + reach, z0 + d));
      }
      context.strokeStyle = whole ? "#c3cad2" : "#e3e7eb";
      context.stroke();
    }
    // Each ellipsoid's shadow from straight above.
    context.fillStyle = "rgba(40,50,60,0.10)";
    const down = this.level[1];
    for (const { ellipsoids } of people) {
      for (const { centre, axes, radii } of ellipsoids) {
        const [cx, , cz] = centre.map((value, i) => value + (down[i] * (height + b * centre[0] + c * centre[2] - centre[1])) / (down[1] - b * down[0] - c * down[2]));
        let xx = 0, xz = 0, zz = 0;
        for (let i = 0; i < 3; i++) {
          const r2 = radii[i] * radii[i];
          xx += r2 * axes[i][0] * axes[i][0]; xz += r2 * axes[i][0] * axes[i][2]; zz += r2 * axes[i][2] * axes[i][2];
        }
        const wide = Math.sqrt(xx), skew = xz / wide, deep = Math.sqrt(Math.max(zz - skew * skew, 1e-9));
        context.beginPath();
        for (let i = 0; i < 24; i++) {
          const cos = Math.cos((i * Math.PI) / 12), sin = Math.sin((i * Math.PI) / 12);
          const p = this.toView(view.R, ...onFloor(cx + wide * cos, cz + skew * cos + deep * sin));
          if (p[2] > 0.1) context.lineTo(...this.pixel(view, p));
        }
        context.fill();
      }
    }
  }

  drawSolid(view, ratio, people, clouds) {
    const scale = Math.min(2 * ratio, Math.sqrt(MOST_PIXELS / (view.width * view.height)));
    const W = Math.max(Math.round(view.width * scale), 1), H = Math.max(Math.round(view.height * scale), 1);
    if (!this.depth || this.buffer.width !== W || this.buffer.height !== H) {
      this.buffer.width = W;
      this.buffer.height = H;
      this.depth = new Float32Array(W * H);
      this.pixels = this.buffer.getContext("2d").createImageData(W, H);
      this.words = new Uint32Array(this.pixels.data.buffer);
    }
    this.depth.fill(Infinity);
    this.words.fill(0);
    for (const { ellipsoids } of people) {
      ellipsoids.forEach((one, part) => this.castEllipsoid(view, W, H, view.focal * scale, one, this.colours[part]));
    }
    for (const cloud of clouds) this.castPoints(view, W, H, view.focal * scale, cloud, 1.25 * scale);
    this.buffer.getContext("2d").putImageData(this.pixels, 0, 0);
    this.context.imageSmoothingQuality = "high";
    this.context.drawImage(this.buffer, 0, 0, view.width, view.height);
  }

  // A ray (x, y, 1) t meets |k + A (x, y, 1) t| = 1, the ellipsoid in the frame in which it is the unit sphere.
  castEllipsoid(view, W, H, focal, { centre, axes, radii }, colour) {
    const c = this.toView(view.R, ...centre), R = view.R;
    const A = [], k = [0, 0, 0];
    let xx = 0, yy = 0, zz = 0, xz = 0, yz = 0;
    for (let i = 0; i < 3; i++) {
      const v = [0, 1, 2].map((row) => R[row][0] * axes[i][0] + R[row][1] * axes[i][1] + R[row][2] * axes[i][2]);
      A.push([v[0] / radii[i], v[1] / radii[i], v[2] / radii[i]]);
      k[i] = -(A[i][0] * c[0] + A[i][1] * c[1] + A[i][2] * c[2]);
      const r2 = radii[i] * radii[i];
      xx += r2 * v[0] * v[0]; yy += r2 * v[1] * v[1]; zz += r2 * v[2] * v[2];
      xz += r2 * v[0] * v[2]; yz += r2 * v[1] * v[2];
    }
    // The image's bounds, from the dual conic c c' - M; an ellipsoid around the eye has none and is left out.
    const q22 = c[2] * c[2] - zz;
    if (c[2] <= 0 || q22 <= 0) return;
    const q02 = c[0] * c[2] - xz, q12 = c[1] * c[2] - yz;
    const du = Math.sqrt(Math.max(q02 * q02 - (c[0] * c[0] - xx) * q22, 0)) / q22;
    const dv = Math.sqrt(Math.max(q12 * q12 - (c[1] * c[1] - yy) * q22, 0)) / q22;
    const u0 = Math.max(Math.floor(W / 2 + focal * (q02 / q22 - du)), 0), u1 = Math.min(Math.ceil(W / 2 + focal * (q02 / q22 + du)), W - 1);
    const v0 = Math.max(Math.floor(H / 2 + focal * (q12 / q22 - dv)), 0), v1 = Math.min(Math.ceil(H / 2 + focal * (q12 / q22 + dv)), H - 1);
    const kk = k[0] * k[0] + k[1] * k[1] + k[2] * k[2] - 1;
    const [A0, A1, A2] = A, depth = this.depth, words = this.words;
    const red = colour[0] + PALE * (255 - colour[0]), green = colour[1] + PALE * (255 - colour[1]), blue = colour[2] + PALE * (255 - colour[2]);
    for (let v = v0; v <= v1; v++) {
      const y = (v + 0.5 - H / 2) / focal;
      for (let u = u0; u <= u1; u++) {
        const x = (u + 0.5 - W / 2) / focal;
        const d0 = A0[0] * x + A0[1] * y + A0[2], d1 = A1[0] * x + A1[1] * y + A1[2], d2 = A2[0] * x + A2[1] * y + A2[2];
        const a = d0 * d0 + d1 * d1 + d2 * d2, b = k[0] * d0 + k[1] * d1 + k[2] * d2;
        const root = b * b - a * kk;
        if (root <= 0) continue;
        const t = (-b - Math.sqrt(root)) / a, at = v * W + u;
        if (t <= 0 || t >= depth[at]) continue;
        depth[at] = t;
        const s0 = k[0] + t * d0, s1 = k[1] + t * d1, s2 = k[2] + t * d2;
        const nx = s0 * A0[0] + s1 * A1[0] + s2 * A2[0], ny = s0 * A0[1] + s1 * A1[1] + s2 * A2[1], nz = s0 * A0[2] + s1 * A1[2] + s2 * A2[2];
        const length = Math.sqrt(nx * nx + ny * ny + nz * nz);
        const lit = Math.max((nx * LIGHT[0] + ny * LIGHT[1] + nz * LIGHT[2]) / length, 0);
        const facing = Math.min(1, -nz / length / Math.sqrt(x * x + y * y + 1) + 0.35); // darker towards the rim
        const shade = (0.5 + 0.52 * lit) * (0.55 + 0.45 * facing);
        words[at] = 0xff000000 | (Math.min(blue * shade, 255) << 16) | (Math.min(green * shade, 255) << 8) | Math.min(red * shade, 255);
      }
    }
  }

  castPoints(view, W, H, focal, { points, labels }, radius) {
    const depth = this.depth, words = this.words, size = Math.ceil(radius), inner = (0.62 * radius) ** 2;
    for (let i = 0; i < labels.length; i++) {
      const p = this.toView(view.R, points[3 * i], points[3 * i + 1], points[3 * i + 2]);
      if (!(p[2] > 0.1)) continue;
      const [red, green, blue] = this.colours[labels[i] < 0 ? this.colours.length - 1 : labels[i]];
      const full = 0xff000000 | (blue << 16) | (green << 8) | red;
      const dark = 0xff000000 | ((blue >> 1) << 16) | ((green >> 1) << 8) | (red >> 1);
      const u = W / 2 + (focal * p[0]) / p[2], v = H / 2 + (focal * p[1]) / p[2], z = p[2] - NEARER;
      for (let row = Math.floor(v - size); row <= v + size; row++) {
        if (row < 0 || row >= H) continue;
        for (let column = Math.floor(u - size); column <= u + size; column++) {
          if (column < 0 || column >= W) continue;
          const off = (row + 0.5 - v) ** 2 + (column + 0.5 - u) ** 2, at = row * W + column;
          if (off > radius * radius || z >= depth[at]) continue;
          depth[at] = z;
          words[at] = off < inner ? full : dark;
        }
      }
    }
  }

  drawSkeleton(view, joints) {
    const context = this.context;
    const pixels = joints.map((joint) => {
      const p = joint && this.toView(view.R, ...joint);
      return p && p[2] > 0.1 ? this.pixel(view, p) : null;
    });
    context.lineCap = "round";
    for (const [width, rim] of [[4.4, true], [2.2, false]]) {
      this.bones.forEach(([start, end], bone) => {
        if (!pixels[start] || !pixels[end]) return;
        context.beginPath();
        context.moveTo(...pixels[start]);
        context.lineTo(...pixels[end]);
        context.lineWidth = width;
        context.strokeStyle = rim ? "#1b1f24" : this.boneColours[bone];
        context.stroke();
      });
    }
    context.lineWidth = 1;
    context.strokeStyle = "#1b1f24";
    context.fillStyle = "#fff";
    for (const pixel of pixels) {
      if (!pixel) continue;
      context.beginPath();
      context.arc(...pixel, 2.4, 0, 2 * Math.PI);
      context.fill();
      context.stroke();
    }
  }

  drawName(view, { name, ellipsoids }) {
    const tops = ellipsoids.map(({ centre }) => this.toView(view.R, ...centre)).filter((p) => p[2] > 0.1).map((p) => this.pixel(view, p));
    if (!name || !tops.length) return;
    const [x, y] = tops.reduce((top, next) => (next[1] < top[1] ? next : top));
    this.context.font = "600 12px system-ui, sans-serif";
    this.context.textAlign = "center";
    this.context.textBaseline = "middle";
    this.context.fillStyle = "#1b1f24";
    this.context.fillText(name, x, y - 0.2 * view.focal / this.look.distance - 4);
  }

  drawCompass(view) {
    const context = this.context, middle = [26, view.height - 26];
    const names = [["x", "#8a1c00", [1, 0, 0]], ["y", "#00592d", [0, 1, 0]], ["z", "#003c96", [0, 0, 1]]];
    context.font = "600 10px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineWidth = 1.5;
    for (const [name, colour, axis] of names) {
      const [x, y] = view.R.map((row) => row[0] * axis[0] + row[1] * axis[1] + row[2] * axis[2]);
      context.strokeStyle = context.fillStyle = colour;
      context.beginPath();
      context.moveTo(...middle);
      context.lineTo(middle[0] + 14 * x, middle[1] + 14 * y);
      context.stroke();
      if (Math.hypot(x, y) > 0.3) context.fillText(name, middle[0] + 20 * x, middle[1] + 20 * y);
    }
  }
}
