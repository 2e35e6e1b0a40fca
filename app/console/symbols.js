/** The aircraft's symbols: a shape for every conformance, drawn the same on the map and in the lists. */

import { standing } from "/console/words.js";

/** In the order of the atlas. */
export const SYMBOLS = ["conforming", "deviating", "violating", "lost", "unseen", "grounded", "scheduled", "planned"];

const DART = [[0, -0.62], [0.42, 0.55], [0, 0.3], [-0.42, 0.55]];

/** Return which symbol a flight or track gets. */
export function symbolOf(flight) {
  const stands = standing(flight);
  return stands === "conforming" && flight.position?.airborne === false ? "grounded" : stands;
}

/** Draw a symbol into a square of `size` pixels whose corner is at (x, y); it points up. */
function drawSymbol(context, symbol, colours, x, y, size) {
  const half = size / 2;
  context.save();
  context.translate(x + half, y + half);
  context.scale(half, half);
  context.lineJoin = "round";
  PAINTERS[symbol](context, colours);
  context.restore();
}

/** Return a canvas with one symbol, for a list; `size` in CSS pixels. */
export function symbolCanvas(symbol, colours, size = 22) {
  const canvas = document.createElement("canvas");
  const scale = devicePixelRatio || 1;
  canvas.width = canvas.height = Math.round(size * scale);
  canvas.className = "symbol";
  drawSymbol(canvas.getContext("2d"), symbol, colours, 0, 0, canvas.width);
  return canvas;
}

/** Return all symbols side by side, each in a square of `cell` pixels. */
export function atlas(colours, cell) {
  const canvas = document.createElement("canvas");
  canvas.width = cell * SYMBOLS.length;
  canvas.height = cell;
  const context = canvas.getContext("2d");
  SYMBOLS.forEach((symbol, at) => drawSymbol(context, symbol, colours, at * cell, 0, cell));
  return canvas;
}

const PAINTERS = {
  conforming: (context, { aircraft, outline }) => dart(context, aircraft, outline),
  deviating: (context, { yellow, outline }) => {
    ring(context, yellow, outline);
    dart(context, yellow, outline, 0.78);
  },
  violating: (context, { red, outline }) => {
    square(context, red, outline);
    dart(context, red, outline, 0.82);
  },
  lost: (context, { yellow, outline }) => {
    context.setLineDash([0.28, 0.2]);
    ring(context, yellow, outline);
    context.setLineDash([]);
    hollowDart(context, yellow, outline);
  },
  unseen: (context, { yellow, outline }) => {
    disc(context, 0.34, outline, null, 0.3);
    disc(context, 0.34, yellow, null, 0.16);
  },
  grounded: (context, { aircraft, outline }) => disc(context, 0.26, outline, aircraft, 0.14),
  scheduled: (context, { aircraft, outline }) => {
    disc(context, 0.26, outline, null, 0.26);
    disc(context, 0.26, aircraft, null, 0.12);
  },
  planned: (context, { accent, outline }) => hollowDart(context, accent, outline, 1),
};

function dart(context, fill, outline, scale = 1) {
  trace(context, scale);
  context.strokeStyle = outline;
  context.lineWidth = 0.26;
  context.stroke();
  context.fillStyle = fill;
  context.fill();
}

function hollowDart(context, colour, outline, scale = 0.74) {
  trace(context, scale);
  context.strokeStyle = outline;
  context.lineWidth = 0.34;
  context.stroke();
  context.strokeStyle = colour;
  context.lineWidth = 0.16;
  context.stroke();
}

function trace(context, scale) {
  context.beginPath();
  for (const [x, y] of DART) context.lineTo(x * scale, y * scale);
  context.closePath();
}

function ring(context, colour, outline) {
  disc(context, 0.82, outline, null, 0.24);
  disc(context, 0.82, colour, null, 0.13);
}

function disc(context, radius, stroke, fill, width) {
  context.beginPath();
  context.arc(0, 0, radius, 0, 2 * Math.PI);
  if (fill) {
    context.fillStyle = fill;
    context.fill();
  }
  context.strokeStyle = stroke;
  context.lineWidth = width;
  context.stroke();
}

function square(context, colour, outline) {
  for (const [stroke, width] of [[outline, 0.3], [colour, 0.18]]) {
    context.strokeStyle = stroke;
    context.lineWidth = width;
    context.strokeRect(-0.8, -0.8, 1.6, 1.6);
  }
}
