// WebGL2. First pass: values, as numbers, are blended into a float target. Second pass: what was blended becomes degrees, and
// degrees become colours. The geometry is that of heatsplat.kernels.projection.

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp sampler2D;
layout(location = 0) in uint id;
uniform sampler2D places, turns, sizes, values, colours;
uniform vec3 right, down, forward, centre;
uniform vec4 intrinsics, limits;   // fx fy cx cy; x/z and y/z at which the Jacobian is clamped
uniform vec2 canvas;
uniform float eps2d;
uniform bool antialiased, coloured;
out vec2 offset;
flat out float opacity;
flat out vec3 value;

const int RIM[8] = int[8](0, 1, 7, 2, 6, 3, 5, 4);  // corners of an octagon, as a strip of triangles

void main() {
  ivec2 at = ivec2(int(id) % WIDTH, int(id) / WIDTH);
  vec4 place = texelFetch(places, at, 0);
  vec3 d = place.xyz - centre;
  float z = dot(forward, d);
  vec2 slope = vec2(dot(right, d), dot(down, d)) / z;
  vec2 mean = intrinsics.xy * slope + intrinsics.zw;
  vec2 t = clamp(slope, limits.xz, limits.yw);
  vec3 rowX = intrinsics.x / z * (right - t.x * forward), rowY = intrinsics.y / z * (down - t.y * forward);
  vec4 q = texelFetch(turns, at, 0);  // w x y z
  q /= length(q);
  mat3 axes = mat3(
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  vec4 size = texelFetch(sizes, at, 0);
  vec3 u = (rowX * axes) * size.xyz, v = (rowY * axes) * size.xyz;
  float uu = dot(u, u), vv = dot(v, v), a = uu + eps2d, b = dot(u, v), c = vv + eps2d;
  vec3 normal = cross(u, v);
  float sharp = dot(normal, normal), det = sharp + eps2d * (uu + vv) + eps2d * eps2d;
  opacity = coloured ? size.w : place.w;
  if (antialiased) opacity *= sqrt(sharp / det);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside
  if (!(opacity >= 1.0 / 255.0) || !(det > 0.0)) return;
  float extent = sqrt(2.0 * log(255.0 * opacity));
  if (any(lessThan(mean + extent * sqrt(vec2(a, c)), vec2(0.0))) || any(greaterThan(mean - extent * sqrt(vec2(a, c)), canvas))) return;
  // An octagon around a circle, which the Cholesky factor of the covariance takes to one around the ellipse: a sixth fewer
  // pixels than a square.
  float corner = 0.78539816 * (float(RIM[gl_VertexID]) + 0.5);
  offset = vec2(cos(corner), sin(corner)) * (extent / 0.92387953);
  float root = sqrt(a);
  vec2 pixel = mean + vec2(root * offset.x, b / root * offset.x + sqrt(det / a) * offset.y);
  gl_Position = vec4(pixel.x / canvas.x * 2.0 - 1.0, 1.0 - pixel.y / canvas.y * 2.0, 0.0, 1.0);
  value = coloured ? texelFetch(colours, at, 0).rgb : vec3(texelFetch(values, at, 0).rg, 0.0);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
flat in float opacity;
flat in vec3 value;
out vec4 blended;

void main() {
  float alpha = min(opacity * exp(-0.5 * dot(offset, offset)), 0.999);
  if (alpha < 1.0 / 255.0) discard;
  blended = vec4(value * alpha, alpha);
}`;

const SHOW_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

const SHOW_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D first, second, visible, table, secondTable, map, differences, picture;
uniform vec2 range, spread, limits, limitsOfRun, learned, background;  // background: of first and second
uniform vec3 paper;
uniform vec4 frame;          // left, top, width, height of the camera's image on the canvas
uniform int kind, other;     // kind: 0 temperature, 1 attribute, 2 visible light; other: see below
uniform vec2 isotherm;       // ends between which values have one colour
uniform bool difference, clampFirst, clampSecond, addPicture, marked;
uniform float split, height;
out vec4 shown;

const int NOTHING = 0, SAME = 1, RUN = 2, VISIBLE = 3, RECORDED = 4, SENSOR = 5;

float decoded(sampler2D entries, float share) {
  int last = textureSize(entries, 0).x - 1;
  float place = clamp(share, 0.0, 1.0) * float(last);
  int i = min(int(place), last - 1);
  return mix(texelFetch(entries, ivec2(i, 0), 0).r, texelFetch(entries, ivec2(i + 1, 0), 0).r, place - float(i));
}

vec4 paint(sampler2D colours, float value, vec2 ends, float alpha) {
  float share = clamp((value - ends.x) / max(ends.y - ends.x, 1e-9), 0.0, 1.0);
  vec3 colour = texture(colours, vec2((share * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  if (marked && value >= isotherm.x && value <= isotherm.y) colour = vec3(MARKED);
  return vec4(mix(paper, colour, smoothstep(0.005, 0.05, alpha)), 1.0);
}

void main() {
  vec2 corner = vec2(gl_FragCoord.x, height - gl_FragCoord.y);
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 a = texelFetch(first, at, 0);
  float behind = 1.0 - a.a;
  if (kind == 2) {
    vec4 seen = texelFetch(visible, at, 0);
    shown = vec4(mix(paper, seen.rgb / max(seen.a, 1e-6), smoothstep(0.005, 0.05, seen.a)), 1.0);
    return;
  }
  if (kind == 1) {
    bool told = a.g >= MOSTLY * a.a;  // the share that has the attribute
    shown = told ? paint(map, mix(learned.x, learned.y, a.r / max(a.g, 1e-6)), range, a.a) : vec4(paper, 1.0);
    return;
  }
  float value = decoded(table, a.r + behind * background.x);
  if (clampFirst) value = clamp(value, limits.x, limits.y);
  vec2 inside = (corner - frame.xy) / frame.zw;
  bool within = all(greaterThanEqual(inside, vec2(0.0))) && all(lessThanEqual(inside, vec2(1.0)));
  float alpha = a.a;
  float beside = value;
  bool known = true;
  if (other == SAME) {
    beside = decoded(table, a.g + behind * background.x);
    if (clampSecond) beside = clamp(beside, limits.x, limits.y);
  } else if (other == RUN) {
    vec4 b = texelFetch(second, at, 0);
    beside = decoded(secondTable, b.r + (1.0 - b.a) * background.y);
    if (clampSecond) beside = clamp(beside, limitsOfRun.x, limitsOfRun.y);
    if (difference) alpha = min(alpha, b.a);
    else if (corner.x > split) alpha = b.a;
  } else if (other == RECORDED || other == SENSOR) {
    vec2 stored = texture(picture, inside).rg;
    known = within && stored.g > 0.99;
    beside = other == SENSOR ? clamp(value + stored.r, limits.x, limits.y) : stored.r;
  } else if (other == VISIBLE && corner.x > split) {
    vec4 seen = texelFetch(visible, at, 0);
    shown = vec4(mix(paper, seen.rgb / max(seen.a, 1e-6), smoothstep(0.005, 0.05, seen.a)), 1.0);
    return;
  }
  if (!known && (difference || corner.x > split)) {
    shown = vec4(paper, 1.0);
    return;
  }
  if (other != NOTHING && difference) shown = paint(differences, value - beside, spread, alpha);
  else if (other != NOTHING && corner.x > split) shown = paint(map, beside, range, other == RECORDED ? 1.0 : alpha);
  else shown = paint(map, value, range, alpha);
}`;

// Pixels² of a canvas by which splats are widened where a training image's pixel is ``scale`` of its pixels wide. The blur is that
// of the pixels that training rendered, ``finer`` of which lie beside a pixel of an image (super-resolution); a coarser pixel
// also averages what lies in it (renderers/settings). Older pages do not tell how fine.
function blurOn({ eps2d, antialiased, finer = 1 }, scale) {
  const side = scale / finer;
  return eps2d * side * side + (antialiased && side < 1 ? (1 - side * side) / 12 : 0);
}

const OTHERS = { nothing: 0, same: 1, run: 2, visible: 3, recorded: 4, sensor: 5 };
const WIDTH = 2048;

class Drawing {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser offers no WebGL 2. Update it, or turn hardware acceleration on.");
    this.gl = gl;
    this.canvas = canvas;
    const floats = gl.getExtension("EXT_color_buffer_float"), halves = gl.getExtension("EXT_color_buffer_half_float");
    const kinds = [{ format: gl.RGBA8, type: gl.UNSIGNED_BYTE, name: "8 bits" }];
    if (floats || halves) kinds.unshift({ format: gl.RGBA16F, type: gl.HALF_FLOAT, name: "16-bit floats" });
    if (floats && gl.getExtension("EXT_float_blend")) kinds.unshift({ format: gl.RGBA32F, type: gl.FLOAT, name: "32-bit floats" });
    // 16-bit floats have half the bytes, and many graphics cards blend 32-bit ones at a fraction of the pace.
    [this.exact, this.quicker] = [kinds[0], kinds[0].type === gl.FLOAT ? kinds[1] : kinds[0]];
    this.quick = false;
    this.splatting = this.program(SPLAT_VERTEX.replaceAll("WIDTH", WIDTH), SPLAT_FRAGMENT);
    this.showing = this.program(SHOW_VERTEX, SHOW_FRAGMENT.replaceAll("MOSTLY", MOSTLY).replaceAll("MARKED", MARKED.join()));
    this.empty = gl.createVertexArray();
    this.targets = {};
    this.blank = this.texture(gl.RGBA8, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  texture(format, width, height, layout, type, content, smooth = false) {
    const gl = this.gl, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, layout, type, content);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, smooth ? gl.LINEAR : gl.NEAREST);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    return made;
  }

  // What the graphics card keeps of a scene.
  load(splats) {
    const gl = this.gl, rows = Math.max(1, Math.ceil(splats.count / WIDTH)), cells = WIDTH * rows;
    const four = (write) => {
      const content = new Float32Array(4 * cells);
      for (let i = 0; i < splats.count; i++) write(content, 4 * i, i);
      return this.texture(gl.RGBA32F, WIDTH, rows, gl.RGBA, gl.FLOAT, content);
    };
    const { means, scales, quats, opacities, colours, colourOpacities } = splats;
    const scene = { splats, rows, seen: 0, ready: false, pixel: 1 };  // pixel: how wide one of its images is, in those of the view's camera
    scene.places = four((to, j, i) => to.set([means[3 * i], means[3 * i + 1], means[3 * i + 2], opacities[i]], j));
    scene.turns = four((to, j, i) => to.set(quats.subarray(4 * i, 4 * i + 4), j));
    scene.sizes = four((to, j, i) => to.set([scales[3 * i], scales[3 * i + 1], scales[3 * i + 2], colourOpacities ? colourOpacities[i] : 0], j));
    scene.filled = new Float32Array(2 * cells);
    scene.values = this.texture(gl.RG32F, WIDTH, rows, gl.RG, gl.FLOAT, scene.filled);
    scene.table = this.texture(gl.R32F, splats.table.length, 1, gl.RED, gl.FLOAT, splats.table);
    if (colours) {
      const content = new Uint8Array(3 * cells);
      content.set(colours);
      scene.colours = this.texture(gl.RGB8, WIDTH, rows, gl.RGB, gl.UNSIGNED_BYTE, content);
    }
    scene.ids = gl.createBuffer();
    scene.array = gl.createVertexArray();
    gl.bindVertexArray(scene.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, scene.ids);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.bindVertexArray(null);
    return scene;
  }

  order(scene, ids) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, scene.ids);
    gl.bufferData(gl.ARRAY_BUFFER, ids, gl.DYNAMIC_DRAW);
    scene.seen = ids.length;
    scene.ready = true;
  }

  // Takes over scene.filled.
  update(scene) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, scene.values);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, scene.rows, gl.RG, gl.FLOAT, scene.filled);
  }

  target(name, width, height) {
    const gl = this.gl, kind = this.quick ? this.quicker : this.exact;
    let made = this.targets[name];
    if (made && made.width === width && made.height === height && made.kind === kind) return made;
    if (made) {
      gl.deleteTexture(made.texture);
      gl.deleteFramebuffer(made.buffer);
    }
    const texture = this.texture(kind.format, width, height, gl.RGBA, kind.type, null);
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    made = this.targets[name] = { texture, buffer, width, height, kind };
    return made;
  }

  bind(program, textures) {
    const gl = this.gl;
    Object.entries(textures).forEach(([name, texture], slot) => {
      gl.activeTexture(gl.TEXTURE0 + slot);
      gl.bindTexture(gl.TEXTURE_2D, texture || this.blank);
      gl.uniform1i(program.uniforms[name], slot);
    });
    gl.activeTexture(gl.TEXTURE0);
  }

  // Blends a scene as a camera sees it into the target of that name. view: camera, scale, left, top on the canvas.
  blend(scene, view, name, coloured = false) {
    const gl = this.gl, { width, height } = this.canvas;
    const target = this.target(name, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!scene.ready || !scene.seen) return target;
    const { program, uniforms } = this.splatting;
    gl.useProgram(program);
    const { camera, scale, left, top } = view;
    const [fx, fy, cx, cy] = camera.intrinsics;
    const { antialiased } = scene.splats.told.renderer, blur = blurOn(scene.splats.told.renderer, scale * scene.pixel);
    const margin = FOV_MARGIN * 0.5;
    const edges = [Math.min(-cx - margin * camera.width, -cx - left / scale) / fx,
      Math.max(camera.width - cx + margin * camera.width, (width - left) / scale - cx) / fx,
      Math.min(-cy - margin * camera.height, -cy - top / scale) / fy,
      Math.max(camera.height - cy + margin * camera.height, (height - top) / scale - cy) / fy];
    gl.uniform3fv(uniforms.right, camera.right);
    gl.uniform3fv(uniforms.down, camera.down);
    gl.uniform3fv(uniforms.forward, camera.forward);
    gl.uniform3fv(uniforms.centre, camera.centre);
    gl.uniform4f(uniforms.intrinsics, fx * scale, fy * scale, cx * scale + left, cy * scale + top);
    gl.uniform4fv(uniforms.limits, edges);
    gl.uniform2f(uniforms.canvas, width, height);
    gl.uniform1f(uniforms.eps2d, blur);
    gl.uniform1i(uniforms.antialiased, antialiased ? 1 : 0);
    gl.uniform1i(uniforms.coloured, coloured ? 1 : 0);
    const { places, turns, sizes, values, colours } = scene;
    this.bind(this.splatting, { places, turns, sizes, values, colours });
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(scene.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 8, scene.seen);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
    return target;
  }

  // Colours what was blended. settings: the uniforms of the second pass.
  show(textures, settings) {
    const gl = this.gl, { program, uniforms } = this.showing, { width, height } = this.canvas;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.useProgram(program);
    this.bind(this.showing, textures);
    const { ints, floats } = settings;
    for (const [name, value] of Object.entries(ints)) gl.uniform1i(uniforms[name], Number(value));
    for (const [name, value] of Object.entries(floats)) {
      const numbers = [].concat(value);
      gl[`uniform${numbers.length}fv`](uniforms[name], numbers);
    }
    gl.uniform1f(uniforms.height, height);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // What was blended in a rectangle, as floats [values, second values, -, alpha]; y counts from the top.
  read(name, x, y, width, height) {
    const gl = this.gl, target = this.targets[name];
    if (!target) return null;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    const bytes = target.kind.type === gl.UNSIGNED_BYTE;
    const content = bytes ? new Uint8Array(4 * width * height) : new Float32Array(4 * width * height);
    gl.readPixels(x, target.height - y - height, width, height, gl.RGBA, bytes ? gl.UNSIGNED_BYTE : gl.FLOAT, content);
    return bytes ? Float32Array.from(content, (value) => value / 255) : content;
  }
}
