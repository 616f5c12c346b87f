// The Gaussians of one scene: what they emit at a time, and what a single pixel of them shows, in double precision.

const ALPHA_MIN = 1 / 255, ALPHA_MAX = 0.999, TRANSMITTANCE_MIN = 1e-4, FOV_MARGIN = 0.3;  // of heatsplat.renderers.base
const MOSTLY = 0.5;  // share of what a pixel shows that must have an attribute for the pixel to have one

// Steps of a column: what is left of them, and multiples of 256 where there are any.
function wholeSteps({ rest, many }, array) {
  const whole = Int16Array.from(array(rest));
  if (many) array(many).forEach((times, i) => { whole[i] += 256 * times; });
  return whole;
}

function inUnits(one, array) {
  return Float32Array.from(wholeSteps(one, array), (steps) => steps * one.step);
}

// Depth of the surface that Gaussians of rising depths show, by their weights: the middle of the shortest stretch with so much of them.
// Before a surface and behind it lies opacity, too, so that the mean depth may be far off. Infinity of none.
const STRETCH = 0.4;

function closestDepth(depths, weights) {
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  let found = Infinity, shortest = Infinity, end = 0, inside = 0;
  for (let start = 0; start < depths.length; start++) {
    while (end < depths.length && inside < STRETCH * total) inside += weights[end++];
    if (inside < STRETCH * total) break;
    if (depths[end - 1] - depths[start] < shortest) {
      shortest = depths[end - 1] - depths[start];
      let middle = start;
      for (let half = weights[start]; half < 0.5 * inside; half += weights[middle]) middle += 1;
      found = depths[middle];
    }
    inside -= weights[start];
  }
  return found;
}

class Splats {
  constructor({ told, array }) {
    this.told = told;
    this.array = array;
    this.count = told.count;
    this.means = array(told.means);
    const { low, span } = told.logScales;
    this.scales = Float32Array.from(array(told.logScales), (share) => Math.exp(low + span * share / 65535));
    this.opacities = Float32Array.from(array(told.opacities), (share) => share / 65535);
    this.quats = Float32Array.from(array(told.quats), (q) => q / 32767);
    this.table = array(told.table);
    this.layers = told.layers.map((layer) => ({
      ...layer,
      offsets: inUnits(layer.offsets, array),
      coefficients: layer.coefficients.map((one) => ({ steps: wholeSteps(one, array), size: one.step })),
      curves: layer.curves.map((one) => inUnits(one, array)),
      times: array(layer.times),
    }));
    this.attributes = told.attributes.map((one) => ({ ...one, values: array(one.values) }));
    this.colours = told.colours ? array(told.colours) : null;
    this.colourOpacities = told.colourOpacities ? array(told.colourOpacities) : null;
  }

  layer(name) {
    return this.layers.find((layer) => layer.name === name) || null;
  }

  // Temperature, or image value, of a blended value.
  decoded(blended) {
    const [low, high] = this.told.tableEnds;
    const last = this.table.length - 1;
    const place = Math.min(Math.max((blended - low) / (high - low), 0), 1) * last;
    const i = Math.min(Math.floor(place), last - 1);
    return this.table[i] + (place - i) * (this.table[i + 1] - this.table[i]);
  }

  // As an image shows it: nothing outside the range of the scene.
  shown(blended, layer) {
    const value = this.decoded(blended);
    const [low, high] = this.told.limits;
    return layer.name === "camera" ? Math.min(Math.max(value, low), high) : value;
  }

  // Of a pixel of which the share alpha is covered, from its blended value as ``fill`` scales it.
  valueOf(blended, alpha, layer) {
    const [low, high] = this.told.tableEnds;
    return this.shown(alpha * low + blended * (high - low) + (1 - alpha) * this.told.background, layer);
  }

  // The shared curves of a layer at a time, [rank].
  curvesAt(layer, time) {
    const { times, curves } = layer;
    if (!curves.length) return [];
    let after = 1;
    while (after < times.length - 1 && times[after] < time) after++;
    const share = Math.min(Math.max((time - times[after - 1]) / (times[after] - times[after - 1]), 0), 1);
    return curves.map((curve) => curve[after - 1] * (1 - share) + curve[after] * share);
  }

  // Blended values of all Gaussians at a time, scaled so that the table's ends are 0 and 1, into every ``stride``-th place.
  fill(layer, time, target, start, stride) {
    const [low, high] = this.told.tableEnds;
    const scale = 1 / (high - low);
    const at = this.curvesAt(layer, time);
    for (let i = 0, j = start; i < this.count; i++, j += stride) target[j] = (layer.offsets[i] - low) * scale;
    const none = { steps: new Int16Array(this.count), factor: 0 };
    const columns = layer.coefficients.map(({ steps, size }, k) => ({ steps, factor: at[k] * size * scale }));
    for (let k = 0; k < columns.length; k += 4) {  // four at a time: half the work is to fetch and store the sums
      const [a, b, c, d] = [0, 1, 2, 3].map((more) => columns[k + more] || none);
      const [sa, sb, sc, sd] = [a.steps, b.steps, c.steps, d.steps];
      const [fa, fb, fc, fd] = [a.factor, b.factor, c.factor, d.factor];
      for (let i = 0, j = start; i < this.count; i++, j += stride) {
        target[j] += fa * sa[i] + fb * sb[i] + fc * sc[i] + fd * sd[i];
      }
    }
    if (!layer.clipped) return;
    const [least, most] = [-low * scale, (1 - low) * scale];
    for (let i = 0, j = start; i < this.count; i++, j += stride) target[j] = Math.min(Math.max(target[j], least), most);
  }

  // An attribute as a share between its ends, and beside it whether a Gaussian has one: 65535 stands for none.
  fillAttribute(one, target) {
    for (let i = 0; i < this.count; i++) {
      const known = one.values[i] !== 65535;
      target[2 * i] = known ? one.values[i] / 65534 : 0;
      target[2 * i + 1] = Number(known);
    }
  }

  // Gaussians that reach a pixel of a camera, front to back, with their blending weights: what the renderer does there.
  weightsAt(camera, px, py) {
    const { means, quats, scales, opacities } = this;
    const { eps2d, antialiased, near, far } = this.told.renderer;
    const [fx, fy, cx, cy] = camera.intrinsics;
    const { right, down, forward, centre, width, height } = camera;
    const marginX = FOV_MARGIN * 0.5 * width / fx, marginY = FOV_MARGIN * 0.5 * height / fy;
    const lowX = -cx / fx - marginX, highX = (width - cx) / fx + marginX;
    const lowY = -cy / fy - marginY, highY = (height - cy) / fy + marginY;
    const reached = [];
    for (let i = 0; i < this.count; i++) {
      const dx = means[3 * i] - centre[0], dy = means[3 * i + 1] - centre[1], dz = means[3 * i + 2] - centre[2];
      const z = forward[0] * dx + forward[1] * dy + forward[2] * dz;
      if (!(z > 0 && z >= near && z <= far)) continue;
      const x = (right[0] * dx + right[1] * dy + right[2] * dz) / z;
      const y = (down[0] * dx + down[1] * dy + down[2] * dz) / z;
      const offX = px - (fx * x + cx), offY = py - (fy * y + cy);
      const sx = scales[3 * i], sy = scales[3 * i + 1], sz = scales[3 * i + 2];
      const tx = Math.min(Math.max(x, lowX), highX), ty = Math.min(Math.max(y, lowY), highY);
      const stretch = Math.max(fx, fy) / z * (1 + Math.hypot(tx, ty));
      const reach = 3.4 * Math.sqrt((Math.max(sx, sy, sz) * stretch) ** 2 + eps2d) + 1;
      if (Math.abs(offX) > reach || Math.abs(offY) > reach) continue;
      const qw = quats[4 * i], qx = quats[4 * i + 1], qy = quats[4 * i + 2], qz = quats[4 * i + 3];
      const axes = [
        [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + qw * qz), 2 * (qx * qz - qw * qy)],
        [2 * (qx * qy - qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + qw * qx)],
        [2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy)],
      ];
      const rowX = scaled(plus(right, forward, -tx), fx / z), rowY = scaled(plus(down, forward, -ty), fy / z);
      const sizes = [sx, sy, sz];
      const u = axes.map((axis, k) => dot(rowX, axis) * sizes[k]), v = axes.map((axis, k) => dot(rowY, axis) * sizes[k]);
      const uu = dot(u, u), vv = dot(v, v), a = uu + eps2d, b = dot(u, v), c = vv + eps2d;
      const normal = cross(u, v), sharp = dot(normal, normal);
      const det = sharp + eps2d * (uu + vv) + eps2d * eps2d;
      let opacity = opacities[i];
      if (antialiased) opacity *= Math.sqrt(sharp / det);
      const alpha = Math.min(opacity * Math.exp(-0.5 * (c * offX * offX - 2 * b * offX * offY + a * offY * offY) / det), ALPHA_MAX);
      if (alpha >= ALPHA_MIN) reached.push([z, i, alpha]);
    }
    reached.sort((p, q) => p[0] - q[0] || p[1] - q[1]);
    const ids = [], weights = [], depths = [];
    let left = 1;
    for (const [z, i, alpha] of reached) {
      if (left * (1 - alpha) <= TRANSMITTANCE_MIN) break;
      ids.push(i);
      weights.push(alpha * left);
      depths.push(z);
      left *= 1 - alpha;
    }
    return { ids, weights, left, depth: closestDepth(depths, weights) };
  }

  // A pixel at some times: the weights stand still, the Gaussians of the pixel change.
  seriesAt(pixel, layer, times) {
    const { ids, weights, left } = pixel, behind = left * this.told.background;
    return times.map((time) => {
      const at = this.curvesAt(layer, time);
      const blended = ids.reduce((total, id, j) => {
        let value = layer.offsets[id];
        layer.coefficients.forEach(({ steps, size }, k) => { value += at[k] * size * steps[id]; });
        return total + weights[j] * (layer.clipped ? Math.min(Math.max(value, 0), 1) : value);
      }, behind);
      return this.shown(blended, layer);
    });
  }

  // The mean over the Gaussians of a pixel that have one; NaN where most have none.
  attributeAt(pixel, one) {
    const { ids, weights, left } = pixel;
    let total = 0, known = 0;
    ids.forEach((id, j) => {
      if (one.values[id] === 65535) return;
      total += weights[j] * one.values[id];
      known += weights[j];
    });
    if (!(known >= MOSTLY * (1 - left))) return NaN;
    const share = total / 65534 / Math.max(known, 1e-9);
    const value = one.low + share * (one.high - one.low);
    return one.log ? 10 ** value : value;
  }
}
