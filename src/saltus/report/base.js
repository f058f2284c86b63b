"use strict";
// Data, units and the few drawing aids every picture on the page shares.

const D = JSON.parse(document.getElementById("data").textContent);
const ARRAYS = { f4: Float32Array, u1: Uint8Array, u2: Uint16Array, i2: Int16Array, i4: Int32Array };

function decode(column) {
  const text = atob(column.b64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = text.charCodeAt(i);
  return new ARRAYS[column.type](bytes.buffer);
}

const S = D.systems; // undefined with one system
for (const part of [D.plots, D.updates, D.gates, ...(S ? [S.members, S.pairs] : [])])
  for (const name in part) if (part[name] && part[name].b64 !== undefined) part[name] = decode(part[name]);

const P = D.plots, U = D.updates, G = D.gates, TRACKS = D.tracks;
const NM = 1852, KT = 1852 / 3600, FL = 30.48;
const COASTED = 2, P_NONE = 255, COURSE_NONE = 65535;
const SPAN = Math.max(D.t1 - D.t0, 1);
const INK = "#17212b", SOFT = "#5a6875", RULE = "#e3e8ec", LINE = "#24476b", HORIZONTAL = "#a8123f", VERTICAL = "#0b7d7a";
const FONT = getComputedStyle(document.documentElement).fontFamily;

const probability = (column, i) => (column[i] === P_NONE ? NaN : column[i] * 0.004);
const course = (i) => (U.course[i] === COURSE_NONE ? NaN : U.course[i] * 0.01);

const state = {
  window: [0, SPAN],
  colour: "ph",
  selected: -1, // index into TRACKS
  hover: null, // {update} or {plot}
  cursor: NaN, // time under the pointer in any time plot
  show: { used: true, unused: true, rejected: false, tentative: false, gates: false, labels: false },
  chosen: [], // tracks pinned by the reader
};

// Redraw once a frame, however many events ask for it.
const painters = [];
let pending = false;
function repaint() {
  if (pending) return;
  pending = true;
  requestAnimationFrame(() => {
    pending = false;
    for (const paint of painters) paint();
  });
}

function element(tag, attributes, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// Fit a canvas's pixels to its place on the page; returns null where it has none.
let sharpness = 0; // set while printing
function prepare(canvas) {
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return null;
  const ratio = sharpness || Math.max(window.devicePixelRatio || 1, 1);
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return { ctx, width, height };
}

const two = (v) => String(v).padStart(2, "0");

function clock(t, seconds = true) {
  const at = new Date((D.t0 + t) * 1000);
  if (isNaN(at)) return "–";
  const text = two(at.getUTCHours()) + ":" + two(at.getUTCMinutes());
  return seconds ? text + ":" + two(at.getUTCSeconds()) : text;
}

function lasting(seconds) {
  const s = Math.round(seconds), h = Math.floor(s / 3600), m = Math.floor(s / 60) % 60;
  return h ? h + ":" + two(m) + ":" + two(s % 60) : m + ":" + two(s % 60);
}

const grouped = (n) => String(n).replace(/\B(?=(\d{3})+$)/g, "\u202f");
const fixed = (v, digits = 0) => (Number.isFinite(v) ? v.toFixed(digits) : "–");
const degrees = (v) => (Number.isFinite(v) ? String(Math.round(v) % 360).padStart(3, "0") + "°" : "–");
const level = (metres) => (Number.isFinite(metres) ? "FL " + two(Math.round(metres / FL)).padStart(3, "0") + " · " + grouped(Math.round(metres)) + " m" : "–");
const octal = (code) => (code < 0 ? "–" : code.toString(8).padStart(4, "0"));

// Steps of 1, 2, 5 times a power of ten; about `count` of them between low and high.
function ticks(low, high, count, least = 0) {
  const rough = Math.max((high - low) / Math.max(count, 1), least, 1e-12);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough * 0.999);
  const out = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + step * 1e-9; v += step) out.push(v);
  return out;
}

const TIME_STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400];
function timeTicks(from, to, count) {
  const step = TIME_STEPS.find((s) => (to - from) / s <= count) || 86400;
  const out = [], offset = D.t0 % step;
  for (let t = Math.ceil((from + offset) / step) * step - offset; t <= to; t += step) out.push(t);
  return { at: out, seconds: step < 60 };
}

function lowerBound(array, value, from, to) {
  while (from < to) {
    const middle = (from + to) >> 1;
    if (array[middle] < value) from = middle + 1;
    else to = middle;
  }
  return from;
}

// The track's update nearest in time.
function nearest(track, t) {
  const i = lowerBound(U.t, t, track.first, track.end);
  if (i === track.first) return i;
  return i === track.end || t - U.t[i - 1] < U.t[i] - t ? i - 1 : i;
}

// Longest silence still drawn as a line: a few update periods of that track.
for (const track of TRACKS) {
  const gaps = [];
  for (let i = track.first + 1; i < track.end; i++) gaps.push(U.t[i] - U.t[i - 1]);
  gaps.sort((a, b) => a - b);
  track.gap = gaps.length ? Math.max(gaps[gaps.length >> 1] * 3.5, 1) : 1;
  track.title = track.callsign || track.icao24 || "Track " + track.id;
  track.text = [track.callsign || track.icao24 ? "track " + track.id : "", track.callsign && track.icao24, track.mode3a && "A" + track.mode3a].filter(Boolean).join(" · ");
}
