// Cameras: OpenCV axes (x right, y down, z forward), world to camera, pixel centres at +0.5.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const length = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => scaled(a, 1 / Math.max(length(a), 1e-12));

// A vector turned about a unit axis by an angle.
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return plus(plus(scaled(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

class Camera {
  // right, down, forward: rows of the rotation; centre: position; intrinsics [fx, fy, cx, cy] of width x height pixels.
  constructor(right, down, forward, centre, intrinsics, width, height) {
    Object.assign(this, { right, down, forward, centre, intrinsics, width, height });
  }

  static of(entry) {
    const m = entry.viewmat;
    const rows = [m.slice(0, 3), m.slice(4, 7), m.slice(8, 11)];
    const t = [m[3], m[7], m[11]];
    const centre = [0, 1, 2].map((i) => -(rows[0][i] * t[0] + rows[1][i] * t[1] + rows[2][i] * t[2]));
    return new Camera(...rows, centre, entry.intrinsics, entry.width, entry.height);
  }

  posed(right, down, forward, centre) {
    return new Camera(right, down, forward, centre, this.intrinsics, this.width, this.height);
  }

  local(point) {
    const d = plus(point, this.centre, -1);
    return [dot(this.right, d), dot(this.down, d), dot(this.forward, d)];
  }

  // Pixel and depth of a world point; null behind the camera.
  project(point) {
    const [x, y, z] = this.local(point);
    if (z <= 1e-9) return null;
    const [fx, fy, cx, cy] = this.intrinsics;
    return [fx * x / z + cx, fy * y / z + cy, z];
  }

  // World point at a pixel and a depth (camera z).
  point(px, py, z) {
    const [fx, fy, cx, cy] = this.intrinsics;
    return plus(plus(plus(this.centre, this.right, (px - cx) / fx * z), this.down, (py - cy) / fy * z), this.forward, z);
  }

  // Looks where it looked, turned about the world's up and its own right, around a point or around itself.
  rotated(yaw, pitch, up, around) {
    const steep = dot(this.forward, up);
    if ((steep > 0.985 && pitch > 0) || (steep < -0.985 && pitch < 0)) pitch = 0;
    const spin = (v) => turned(turned(v, this.right, pitch), up, yaw);
    const centre = around ? plus(around, spin(plus(this.centre, around, -1))) : this.centre;
    return this.posed(unit(spin(this.right)), unit(spin(this.down)), unit(spin(this.forward)), centre);
  }

  // Moved along its own axes.
  moved(right, down, forward) {
    const centre = plus(plus(plus(this.centre, this.right, right), this.down, down), this.forward, forward);
    return this.posed(this.right, this.down, this.forward, centre);
  }
}
