/**
 * What MapLibre has no layer for: aircraft and lines at their altitudes, hundreds of them moving in every frame.
 *
 * A canvas of its own above the map's, so that aircraft move smoothly while city and blocks, which are much dearer, are
 * drawn only when they change. Two programs: sprites are squares that lie in the air, turned by heading, of one size on
 * screen; segments are lines of one width on screen. Nothing hides them: an ops room looks through houses.
 */

import { SYMBOLS, atlas } from "/console/symbols.js";

const SPRITE_FLOATS = 6;
const SEGMENT_FLOATS = 12;
const CELL = 96;
const SPRITE_PX = 30;
const CORNERS = new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]);

const SPRITE_VERTEX = `#version 300 es
uniform mat4 u_matrix;
uniform float u_metres;   // of one pixel, at a depth of 1
uniform float u_half_px;
uniform float u_cells;
in vec2 a_corner;
in vec3 a_position;
in float a_heading;
in float a_cell;
in float a_scale;
out vec2 v_texture;
void main() {
  float w = (u_matrix * vec4(a_position, 1.0)).w;
  vec2 turned = vec2(a_corner.x * cos(a_heading) + a_corner.y * sin(a_heading),
                     a_corner.y * cos(a_heading) - a_corner.x * sin(a_heading));
  vec3 corner = a_position + vec3(turned * u_half_px * a_scale * u_metres * w, 0.0);
  gl_Position = u_matrix * vec4(corner, 1.0);
  v_texture = vec2((a_cell + 0.5 + a_corner.x * 0.5) / u_cells, 0.5 - a_corner.y * 0.5);
}`;

const SPRITE_FRAGMENT = `#version 300 es
precision mediump float;
uniform sampler2D u_atlas;
in vec2 v_texture;
out vec4 colour;
void main() {
  colour = texture(u_atlas, v_texture);
}`;

const SEGMENT_VERTEX = `#version 300 es
uniform mat4 u_matrix;
uniform vec2 u_half_screen;
in vec2 a_corner;
in vec3 a_from;
in vec3 a_to;
in vec4 a_colour;
in float a_width;
in float a_dash;
out vec4 v_colour;
out float v_along;
out float v_off;
out float v_half_width;
out float v_dash;
void main() {
  vec4 from = u_matrix * vec4(a_from, 1.0);
  vec4 to = u_matrix * vec4(a_to, 1.0);
  const float near = 0.001;
  // What is behind the camera has no place on the screen: cut the line at the camera.
  if (from.w < near && to.w > near) from = mix(from, to, (near - from.w) / (to.w - from.w));
  if (to.w < near && from.w > near) to = mix(to, from, (near - to.w) / (from.w - to.w));
  vec2 on_screen = (to.xy / to.w - from.xy / from.w) * u_half_screen;
  float length_px = length(on_screen);
  vec2 along = length_px > 0.0 ? on_screen / length_px : vec2(1.0, 0.0);
  v_off = a_corner.x * (a_width * 0.5 + 0.5);
  vec2 across = vec2(-along.y, along.x) * v_off;
  float end = a_corner.y * 0.5 + 0.5;
  vec4 position = mix(from, to, end);
  // Drawn over by half a width, so that corners of a path have no gaps.
  vec2 over = along * a_corner.y * a_width * 0.25;
  gl_Position = vec4(position.xy + (across + over) / u_half_screen * position.w, 0.0, position.w);
  v_colour = a_colour;
  v_along = end * length_px;
  v_half_width = a_width * 0.5;
  v_dash = a_dash;
}`;

const SEGMENT_FRAGMENT = `#version 300 es
precision highp float;
in vec4 v_colour;
in float v_along;
in float v_off;
in float v_half_width;
in float v_dash;
out vec4 colour;
void main() {
  if (v_dash > 0.0 && mod(v_along, 2.0 * v_dash) > v_dash) discard;
  // Fades out over the last pixel, which is what multisampling would do at many times the price.
  float alpha = v_colour.a * clamp(v_half_width + 0.5 - abs(v_off), 0.0, 1.0);
  colour = vec4(v_colour.rgb * alpha, alpha);
}`;

export class Scene {
  /** Takes local metres to clip space; null before the map's first frame. */
  matrix = null;
  #gl;
  #map;
  #colours;
  #compose;
  #still = new Float32Array(0);
  #batches;
  #texture;
  #atlasIsOld;

  /** `compose` is called for every frame; it returns `{sprites, segments}` of `spriteArray` and `segmentArray`. */
  constructor(map, frame, colours, compose) {
    this.#map = map;
    this.#colours = colours;
    this.#compose = compose;
    const canvas = document.createElement("canvas");
    canvas.className = "scene";
    map.getCanvasContainer().append(canvas);
    this.#gl = canvas.getContext("webgl2", { antialias: false, depth: false });
    this.#prepare();
    // A display that sleeps, or a driver that starts anew, takes away all that was handed over.
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.#prepare());
    map.addLayer({
      id: "camera", type: "custom", renderingMode: "3d",
      render: (_, { defaultProjectionData }) => {
        this.matrix = frame.matrix(defaultProjectionData.mainMatrix);
      },
    });
    map.on("render", () => this.draw());
  }

  /** Take lines that stay as they are for a while. */
  setStill(segments) {
    this.#still = segmentArray(segments);
    fill(this.#gl, this.#batches.still, this.#still);
  }

  /** Draw in other colours from now on. */
  setColours(colours) {
    this.#colours = colours;
    this.#atlasIsOld = true;
  }

  /** Draw a frame, as the map's camera stands. */
  draw() {
    const gl = this.#gl;
    if (this.matrix === null || gl.isContextLost()) return;
    const { width, height, clientWidth, clientHeight } = this.#map.getCanvas();
    if (gl.canvas.width !== width || gl.canvas.height !== height) Object.assign(gl.canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const { sprites, segments } = this.#compose(this.matrix);
    const { still, moving, sprites: aircraft } = this.#batches;
    const matrix = new Float32Array(this.matrix);
    const halfScreen = [clientWidth / 2, clientHeight / 2];

    fill(gl, moving, segments);
    for (const lines of [still, moving]) {
      gl.useProgram(lines.program);
      gl.uniformMatrix4fv(lines.uniform("u_matrix"), false, matrix);
      gl.uniform2fv(lines.uniform("u_half_screen"), halfScreen);
      drawBatch(gl, lines);
    }

    gl.useProgram(aircraft.program);
    if (this.#atlasIsOld) this.#drawAtlas(gl);
    gl.uniformMatrix4fv(aircraft.uniform("u_matrix"), false, matrix);
    gl.uniform1f(aircraft.uniform("u_metres"), metresOfPixel(this.matrix, halfScreen[0]));
    gl.uniform1f(aircraft.uniform("u_half_px"), SPRITE_PX / 2);
    gl.uniform1f(aircraft.uniform("u_cells"), SYMBOLS.length);
    fill(gl, aircraft, sprites);
    drawBatch(gl, aircraft);
  }

  #prepare() {
    const gl = this.#gl;
    const corners = buffer(gl, CORNERS, gl.STATIC_DRAW);
    const lines = [["a_from", 3], ["a_to", 3], ["a_colour", 4], ["a_width", 1], ["a_dash", 1]];
    this.#batches = {
      still: batch(gl, corners, SEGMENT_VERTEX, SEGMENT_FRAGMENT, lines),
      moving: batch(gl, corners, SEGMENT_VERTEX, SEGMENT_FRAGMENT, lines),
      sprites: batch(gl, corners, SPRITE_VERTEX, SPRITE_FRAGMENT, [
        ["a_position", 3], ["a_heading", 1], ["a_cell", 1], ["a_scale", 1],
      ]),
    };
    this.#texture = gl.createTexture();
    this.#atlasIsOld = true;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    fill(gl, this.#batches.still, this.#still);
  }

  #drawAtlas(gl) {
    gl.bindTexture(gl.TEXTURE_2D, this.#texture);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, true);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, atlas(this.#colours, CELL));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_NEAREST);
    gl.generateMipmap(gl.TEXTURE_2D);
    this.#atlasIsOld = false;
  }
}

/** Return sprites `{at, heading, symbol, scale}` as the scene draws them; `at` in local metres. */
export function spriteArray(sprites) {
  const floats = new Float32Array(sprites.length * SPRITE_FLOATS);
  sprites.forEach(({ at, heading, symbol, scale }, index) => {
    floats.set([...at, heading, SYMBOLS.indexOf(symbol), scale], index * SPRITE_FLOATS);
  });
  return floats;
}

/** Return lines `{from, to, colour, width, dash}` as the scene draws them; ends in local metres, the rest in pixels. */
export function segmentArray(segments) {
  const floats = new Float32Array(segments.length * SEGMENT_FLOATS);
  segments.forEach(({ from, to, colour, width, dash = 0 }, index) => {
    floats.set([...from, ...to, ...colour, width, dash], index * SEGMENT_FLOATS);
  });
  return floats;
}

/** Return how many metres a pixel spans across the view, for each unit of depth. */
function metresOfPixel(matrix, halfWidth) {
  return 1 / (Math.hypot(matrix[0], matrix[4], matrix[8]) * halfWidth);
}

/** Hand over a batch's instances. */
function fill(gl, made, floats) {
  gl.bindBuffer(gl.ARRAY_BUFFER, made.buffer);
  gl.bufferData(gl.ARRAY_BUFFER, floats, gl.DYNAMIC_DRAW);
  made.count = floats.length / made.floats;
}

function drawBatch(gl, made) {
  gl.bindVertexArray(made.array);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, made.count);
}

/** Return a program with the square's corners and one buffer of instances laid out as given. */
function batch(gl, corners, vertex, fragment, layout) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  attribute(gl, program, corners, "a_corner", 2, 0, 0, 0);
  const instances = gl.createBuffer();
  const floats = layout.reduce((sum, [, size]) => sum + size, 0);
  let offset = 0;
  for (const [name, size] of layout) {
    attribute(gl, program, instances, name, size, 4 * floats, offset, 1);
    offset += 4 * size;
  }
  gl.bindVertexArray(null);
  const locations = new Map();
  const uniform = (name) => {
    if (!locations.has(name)) locations.set(name, gl.getUniformLocation(program, name));
    return locations.get(name);
  };
  return { program, array, buffer: instances, floats, count: 0, uniform };
}

function attribute(gl, program, source, name, size, stride, offset, divisor) {
  const location = gl.getAttribLocation(program, name);
  gl.bindBuffer(gl.ARRAY_BUFFER, source);
  gl.enableVertexAttribArray(location);
  gl.vertexAttribPointer(location, size, gl.FLOAT, false, stride, offset);
  gl.vertexAttribDivisor(location, divisor);
}

function buffer(gl, data, usage) {
  const made = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, made);
  gl.bufferData(gl.ARRAY_BUFFER, data, usage);
  return made;
}
