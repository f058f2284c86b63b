// The plan view as a picture: rings, plots, tracks, gates.

const map = document.getElementById("map");
const CROWDED = P.class.reduce((n, c) => n + (c > 0), 0) > 4000;
const CLASS_SHOW = ["used", "unused", "rejected"];
const view = { x: 0, y: 0, scale: 1e-3, width: 0, height: 0, fitted: false }; // centre in m, pixels per metre

const sx = (x) => view.width / 2 + (x - view.x) * view.scale;
const sy = (y) => view.height / 2 - (y - view.y) * view.scale;
const drawn = (track) => track.confirmed || state.show.tentative;

// Everything but the wildest points: one false plot far out must not shrink the picture.
function extent() {
  const xs = [], ys = [];
  const put = (x, y) => { if (Number.isFinite(x + y)) { xs.push(x); ys.push(y); } };
  for (const track of TRACKS) if (track.confirmed) for (let i = track.first; i < track.end; i++) put(U.x[i], U.y[i]);
  if (!xs.length) for (let i = 0; i < P.x.length; i++) if (P.class[i] < 2) put(P.x[i], P.y[i]);
  if (!xs.length) for (const site of D.sites) { put(site.x - 9e4, site.y - 9e4); put(site.x + 9e4, site.y + 9e4); }
  if (!xs.length) return [-1e5, -1e5, 1e5, 1e5];
  const trim = (v) => { v = Float64Array.from(v).sort(); const k = Math.floor(v.length * 0.001); return [v[k], v[v.length - 1 - k]]; };
  const [x0, x1] = trim(xs), [y0, y1] = trim(ys), pad = 0.04 * Math.max(x1 - x0, y1 - y0, 400);
  return [x0 - pad, y0 - pad, x1 + pad, y1 + pad];
}
const EXTENT = extent();

// Distance from a site to the farthest track (or plot), the wildest thousandth left out.
function reach(site) {
  if (site.reach) return site.reach;
  const some = U.x.length ? U : P, all = [];
  for (let i = 0; i < some.x.length; i++) if (Number.isFinite(some.x[i])) all.push(Math.hypot(some.x[i] - site.x, some.y[i] - site.y));
  all.sort((a, b) => a - b);
  return (site.reach = all.length ? all[Math.floor(all.length * 0.999)] : 60 * NM);
}

function fit() {
  const [x0, y0, x1, y1] = EXTENT;
  view.x = (x0 + x1) / 2;
  view.y = (y0 + y1) / 2;
  view.scale = Math.min(view.width / (x1 - x0), view.height / (y1 - y0));
  view.fitted = true;
  repaint();
}

const RING_STEPS = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200];
const ringStep = () => RING_STEPS.find((s) => s * NM * view.scale >= 54) || 500; // NM
const mean = (values) => values.reduce((sum, v) => sum + v, 0) / values.length;

// Sites that the eye takes for one at this scale: within a quarter of a ring step of each other.
function siteGroups() {
  const groups = [], near = 0.25 * ringStep() * NM;
  for (const site of D.sites) {
    const group = groups.find((g) => g.every((other) => Math.hypot(site.x - other.x, site.y - other.y) < near));
    if (group) group.push(site);
    else groups.push([site]);
  }
  return groups.map((sites) => ({ sites, x: mean(sites.map((s) => s.x)), y: mean(sites.map((s) => s.y)), reach: Math.max(...sites.map(reach)) }));
}

// Calls put(group of sites, radius in NM) for every ring; the last one encloses the group's data.
function eachRing(groups, put) {
  const step = ringStep();
  for (const group of groups) for (let k = 1; k <= Math.min(Math.ceil(group.reach / NM / step - 0.05), 400); k++) put(group, k * step);
}

function drawRings(ctx, groups) {
  ctx.strokeStyle = groups.length > 3 ? "#eef1f4" : "#dce3e9";
  ctx.lineWidth = 1;
  eachRing(groups, (group, r) => {
    ctx.beginPath();
    ctx.arc(sx(group.x), sy(group.y), r * NM * view.scale, 0, 2 * Math.PI);
    ctx.stroke();
  });
}

function drawRingLabels(ctx, groups) {
  if (groups.length > 3) return;
  const taken = [];
  ctx.font = "11px " + FONT;
  ctx.textAlign = "center";
  ctx.textBaseline = "middle";
  eachRing(groups, (group, r) => {
    const name = `${+r.toFixed(1)} NM · ${+(r * 1.852).toFixed(r < 5 ? 1 : 0)} km`, d = r * NM * view.scale;
    const x = sx(group.x) + d * 0.5, y = sy(group.y) + d * 0.866, w = ctx.measureText(name).width;
    if (x - w / 2 < 3 || x + w / 2 > view.width - 3 || y < 8 || y > view.height - 8) return;
    if (taken.some((b) => Math.abs(b.x - x) < (b.w + w) / 2 + 4 && Math.abs(b.y - y) < 14)) return;
    taken.push({ x, y, w });
    halo(ctx, name, x, y, SOFT);
  });
}

function drawSites(ctx, groups) {
  ctx.font = "600 12px " + FONT;
  ctx.textAlign = "left";
  ctx.textBaseline = "bottom";
  for (const { sites, x: east, y: north } of groups) {
    const apart = Math.max(...sites.map((s) => Math.hypot(s.x - east, s.y - north))) * view.scale > 7;
    const marks = apart ? sites : [{ x: east, y: north }];
    for (const mark of marks) triangle(ctx, sx(mark.x), sy(mark.y));
    const x = Math.max(...marks.map((m) => sx(m.x)));
    halo(ctx, sites.map((s) => s.name).join(", "), x + 8, sy(north) - 3, INK);
  }
}

function triangle(ctx, x, y) {
  ctx.beginPath();
  ctx.moveTo(x, y - 6);
  ctx.lineTo(x + 5.5, y + 4);
  ctx.lineTo(x - 5.5, y + 4);
  ctx.closePath();
  ctx.fillStyle = INK;
  ctx.strokeStyle = "#fff";
  ctx.lineWidth = 2.5;
  ctx.stroke();
  ctx.fill();
}

function halo(ctx, text, x, y, colour) {
  ctx.lineJoin = "round";
  ctx.strokeStyle = "rgba(255,255,255,.9)";
  ctx.lineWidth = 3.5;
  ctx.strokeText(text, x, y);
  ctx.fillStyle = colour;
  ctx.fillText(text, x, y);
}

function drawPlots(ctx) {
  const [from, to] = state.window, near = view.scale > 0.02;
  for (const kind of [2, 1, 0]) {
    if (!state.show[CLASS_SHOW[kind]]) continue;
    const size = kind === 0 ? (near ? 3.4 : 1.5) : near ? 3.4 : CROWDED ? 1.4 : 2.3;
    ctx.beginPath();
    for (let i = 0; i < P.x.length; i++) {
      if (P.class[i] !== kind || P.t[i] < from || P.t[i] > to) continue;
      const x = sx(P.x[i]), y = sy(P.y[i]);
      if (x < -4 || y < -4 || x > view.width + 4 || y > view.height + 4) continue;
      if (kind === 0) ctx.rect(x - size / 2, y - size / 2, size, size);
      else if (kind === 1) { ctx.moveTo(x - size, y - size); ctx.lineTo(x + size, y + size); ctx.moveTo(x + size, y - size); ctx.lineTo(x - size, y + size); }
      else ctx.rect(x - size, y - size, 2 * size, 2 * size);
    }
    if (kind === 0) { ctx.fillStyle = near ? "rgba(95,108,122,.75)" : "rgba(120,132,146,.5)"; ctx.fill(); }
    else { ctx.strokeStyle = kind === 1 ? "#c46a00" : "#7b5ea7"; ctx.lineWidth = 1.1; ctx.stroke(); }
  }
}

const HEIGHTS = (() => {
  const all = Float32Array.from(U.altitude.filter(Number.isFinite)).sort();
  if (!all.length) return [0, 100 * FL];
  const low = Math.floor(all[0] / FL / 10) * 10 * FL;
  return [low, Math.max(Math.ceil(all[all.length - 1] / FL / 10) * 10 * FL, low + 10 * FL)];
})();

// Which of the map's colours an update has; -1 where the quantity is unknown.
function shade(i) {
  const ramp = state.colour === "height" ? D.colours.height : D.colours.p;
  const v = state.colour === "height" ? (U.altitude[i] - HEIGHTS[0]) / (HEIGHTS[1] - HEIGHTS[0]) : probability(U[state.colour], i);
  return Number.isFinite(v) ? Math.max(0, Math.min(ramp.length - 1, Math.floor(v * ramp.length))) : -1;
}

// Sort the visible segments by colour, so that each colour is one stroke; coasted ones apart.
function segments(tracks) {
  const [from, to] = state.window, solid = new Map(), coasted = [], tentative = [];
  for (const track of tracks) {
    for (let i = track.first + 1; i < track.end; i++) {
      if (U.t[i - 1] < from || U.t[i] > to) continue;
      const x0 = sx(U.x[i - 1]), y0 = sy(U.y[i - 1]), x1 = sx(U.x[i]), y1 = sy(U.y[i]);
      if (!Number.isFinite(x0 + y0 + x1 + y1)) continue;
      if (Math.max(x0, x1) < 0 || Math.min(x0, x1) > view.width || Math.max(y0, y1) < 0 || Math.min(y0, y1) > view.height) continue;
      const silent = U.status[i] === COASTED || U.t[i] - U.t[i - 1] > track.gap;
      const k = shade(i);
      let list = silent ? coasted : track.confirmed ? solid.get(k) : tentative;
      if (!list) solid.set(k, (list = []));
      list.push(x0, y0, x1, y1);
    }
  }
  return { solid: [...solid].sort((a, b) => a[0] - b[0]), coasted, tentative };
}

function strokeAll(ctx, list) {
  ctx.beginPath();
  for (let i = 0; i < list.length; i += 4) { ctx.moveTo(list[i], list[i + 1]); ctx.lineTo(list[i + 2], list[i + 3]); }
  ctx.stroke();
}

function drawTracks(ctx, tracks, width) {
  const ramp = state.colour === "height" ? D.colours.height : D.colours.p;
  const { solid, coasted, tentative } = segments(tracks);
  ctx.lineCap = "butt";
  ctx.lineWidth = 1.2;
  ctx.strokeStyle = "#8c98a4";
  ctx.setLineDash([4, 3]);
  strokeAll(ctx, coasted);
  ctx.strokeStyle = "#6f7c89";
  ctx.setLineDash([1.5, 2.5]);
  strokeAll(ctx, tentative);
  ctx.setLineDash([]);
  ctx.lineCap = "round";
  ctx.lineWidth = width;
  for (const [k, list] of solid) {
    ctx.strokeStyle = k < 0 ? "#9aa5af" : ramp[k];
    strokeAll(ctx, list);
  }
}

function drawSelected(ctx) {
  const track = TRACKS[state.selected];
  if (!track) return;
  const { solid, coasted, tentative } = segments([track]);
  ctx.lineCap = ctx.lineJoin = "round";
  for (const [width, colour] of [[7, "rgba(255,255,255,.95)"], [4.6, INK]]) {
    ctx.lineWidth = width;
    ctx.strokeStyle = colour;
    for (const [, list] of solid) strokeAll(ctx, list);
    ctx.lineWidth = width > 5 ? width : 1.6;
    strokeAll(ctx, coasted);
    strokeAll(ctx, tentative);
  }
  drawTracks(ctx, [track], 2.6);
}

function gateShape(ctx, i) {
  if (!Number.isFinite(G.x[i] + G.y[i] + G.e[i] + G.n[i])) return false;
  ctx.moveTo(sx(G.x[i]) + G.e[i] * view.scale, sy(G.y[i]));
  ctx.ellipse(sx(G.x[i]), sy(G.y[i]), G.e[i] * view.scale, G.n[i] * view.scale, 0, 0, 2 * Math.PI);
  return true;
}

const MOST_GATES = 3000;
function drawGates(ctx) {
  const [from, to] = state.window, list = [];
  if (!state.show.gates || !G.any) return;
  for (const track of TRACKS) {
    if (!drawn(track)) continue;
    for (let i = track.first; i < track.end; i++) {
      if (U.t[i] < from || U.t[i] > to || G.e[i] * view.scale < 2.5) continue;
      const x = sx(G.x[i]), y = sy(G.y[i]);
      if (x > 0 && y > 0 && x < view.width && y < view.height) list.push(i);
    }
  }
  if (list.length > MOST_GATES || !list.length) {
    ctx.font = "12.5px " + FONT;
    ctx.textAlign = "center";
    ctx.textBaseline = "top";
    halo(ctx, "Zoom in or shorten the time window to see gates", view.width / 2, 12, SOFT);
    return;
  }
  ctx.beginPath();
  for (const i of list) gateShape(ctx, i);
  ctx.strokeStyle = "rgba(58,110,160,.55)";
  ctx.lineWidth = 1;
  ctx.stroke();
}

function drawLabels(ctx) {
  const [from, to] = state.window, taken = [];
  ctx.font = "11.5px " + FONT;
  ctx.textAlign = "left";
  ctx.textBaseline = "middle";
  const order = TRACKS.map((_, k) => k).filter((k) => k === state.selected || (state.show.labels && TRACKS[k].confirmed));
  order.sort((a, b) => (b === state.selected) - (a === state.selected) || TRACKS[b].n - TRACKS[a].n);
  for (const k of order) {
    const track = TRACKS[k], i = lowerBound(U.t, to + 1e-3, track.first, track.end) - 1;
    if (i < track.first || U.t[i] < from) continue;
    const x = sx(U.x[i]) + 7, y = sy(U.y[i]), w = ctx.measureText(track.label).width;
    if (!(x > 0 && y > 6 && x + w < view.width && y < view.height - 6)) continue;
    if (taken.some((b) => x < b[2] && x + w > b[0] && y - 7 < b[3] && y + 7 > b[1])) continue;
    taken.push([x, y - 7, x + w, y + 7]);
    ctx.beginPath();
    ctx.arc(x - 7, y, k === state.selected ? 3.5 : 2.2, 0, 2 * Math.PI);
    ctx.fillStyle = INK;
    ctx.fill();
    ctx.font = (k === state.selected ? "600 12.5px " : "11.5px ") + FONT;
    halo(ctx, track.label, x, y, INK);
  }
}

function drawFurniture(ctx) {
  const room = 150 / view.scale; // m that may be spanned
  ctx.textBaseline = "alphabetic";
  ctx.lineWidth = 1.5;
  ctx.lineCap = "butt";
  ctx.font = "11.5px " + FONT;
  const bars = [[NM, "NM"], room < 3000 ? [1, "m"] : [1000, "km"]];
  bars.forEach(([unit, name], k) => {
    const power = 10 ** Math.floor(Math.log10(room / unit)), value = [5, 2, 1].map((v) => v * power).find((v) => v * unit <= room);
    const w = value * unit * view.scale, x = 16, y = view.height - 34 + 20 * k;
    ctx.fillStyle = "rgba(255,255,255,.85)";
    ctx.fillRect(x - 4, y - 13, w + 62, 18);
    ctx.strokeStyle = INK;
    ctx.beginPath();
    ctx.moveTo(x, y - 5); ctx.lineTo(x, y); ctx.lineTo(x + w, y); ctx.lineTo(x + w, y - 5);
    ctx.stroke();
    ctx.textAlign = "left";
    ctx.fillStyle = INK;
    ctx.fillText(`${+value.toPrecision(2)} ${name}`, x + w + 6, y);
  });
  const x = view.width - 26, y = 22;
  ctx.beginPath();
  ctx.moveTo(x, y); ctx.lineTo(x + 6, y + 20); ctx.lineTo(x, y + 15); ctx.lineTo(x - 6, y + 20); ctx.closePath();
  ctx.lineWidth = 4; ctx.strokeStyle = "rgba(255,255,255,.9)"; ctx.stroke();
  ctx.fillStyle = INK; ctx.fill();
  ctx.font = "600 12px " + FONT;
  ctx.textAlign = "center";
  halo(ctx, "N", x, y - 5, INK);
}

function drawHover(ctx) {
  const track = TRACKS[state.selected];
  let i = state.hover && state.hover.update;
  if (i === undefined && track && Number.isFinite(state.cursor)) i = nearest(track, state.cursor);
  if (i === undefined || i === null) return;
  ctx.beginPath();
  if (gateShape(ctx, i)) {
    ctx.fillStyle = "rgba(58,110,160,.10)"; ctx.fill();
    ctx.strokeStyle = "#3a6ea0"; ctx.lineWidth = 1.3; ctx.stroke();
  }
  ctx.beginPath();
  ctx.arc(sx(U.x[i]), sy(U.y[i]), 4.5, 0, 2 * Math.PI);
  ctx.fillStyle = "#fff"; ctx.fill();
  ctx.strokeStyle = INK; ctx.lineWidth = 2; ctx.stroke();
}

painters.push(function paintMap() {
  const place = prepare(map);
  if (!place) return;
  const { ctx } = place;
  const resized = view.width !== place.width || view.height !== place.height, whole = !view.fitted || view.whole;
  view.width = place.width;
  view.height = place.height;
  if (resized && whole) { fit(); view.whole = true; }
  ctx.fillStyle = "#fff";
  ctx.fillRect(0, 0, view.width, view.height);
  const groups = siteGroups();
  drawRings(ctx, groups);
  drawPlots(ctx);
  drawTracks(ctx, TRACKS.filter(drawn), view.scale > 0.02 ? 2.2 : 1.5);
  drawGates(ctx);
  drawSelected(ctx);
  drawRingLabels(ctx, groups);
  drawSites(ctx, groups);
  drawLabels(ctx);
  drawHover(ctx);
  drawFurniture(ctx);
});
