// The plan view under the hand: pan, zoom, hover and choice.

const tip = document.getElementById("tip"), readout = document.getElementById("readout");

function pick(px, py) {
  const [from, to] = state.window;
  let best = 12 * 12, hit = null;
  for (let k = 0; k < TRACKS.length; k++) {
    const track = TRACKS[k];
    if (!drawn(track) && k !== state.selected) continue;
    for (let i = track.first; i < track.end; i++) {
      if (U.t[i] < from || U.t[i] > to) continue;
      const d = (sx(U.x[i]) - px) ** 2 + (sy(U.y[i]) - py) ** 2;
      if (d < best) { best = d; hit = { update: i, track: k }; }
    }
  }
  best = Math.min(best, 49) * 0.999; // a plot must be nearer than the track beside it
  for (let i = 0; i < P.x.length; i++) {
    if (P.t[i] < from || P.t[i] > to || P.class[i] === 0 || !state.show[CLASS_SHOW[P.class[i]]]) continue;
    const d = (sx(P.x[i]) - px) ** 2 + (sy(P.y[i]) - py) ** 2;
    if (d < best) { best = d; hit = { plot: i }; }
  }
  return hit;
}

function describe(hit) {
  if (hit.plot !== undefined) {
    const i = hit.plot, why = P.class[i] === 2 ? D.reasons[P.reason[i]] : "on no track";
    return [P.class[i] === 2 ? "Rejected report" : "Unused plot", [["Time", clock(P.t[i])], ["Source", P.sources[P.source[i]] || "–"],
      ["Height", level(P.altitude[i])], ["Mode A", octal(P.mode3a[i])], ["Why", why]]];
  }
  const i = hit.update, track = TRACKS[hit.track], lines = [["Track", String(track.id)], ["Address", track.icao24 || "–"],
    ["Mode A", track.mode3a || "–"], ["Time", clock(U.t[i])], ["Height", level(U.altitude[i])],
    ["Speed", fixed(U.speed[i] / KT) + " kt · " + fixed(U.speed[i]) + " m/s"], ["Course", degrees(course(i))],
    ["P(manoeuvre), horizontal", fixed(probability(U.ph, i), 2)], ["P(manoeuvre), vertical", fixed(probability(U.pv, i), 2)]];
  if (Number.isFinite(G.nis[i])) lines.push(["NIS", fixed(G.nis[i], 1) + " (" + fixed(G.dof[i]) + " dof)"]);
  if (U.status[i] === COASTED) lines.push(["Status", "coasted"]);
  return [track.title, lines];
}

function showTip(hit, px, py) {
  tip.hidden = !hit;
  if (!hit) return;
  const [head, lines] = describe(hit);
  const list = element("dl", {});
  for (const [name, value] of lines) list.append(element("dt", {}, name), element("dd", {}, value));
  tip.replaceChildren(element("b", {}, head), list);
  const w = tip.offsetWidth, h = tip.offsetHeight;
  tip.style.left = (px + 18 + w < view.width ? px + 18 : Math.max(px - w - 18, 4)) + "px";
  tip.style.top = Math.max(4, Math.min(py - h / 2, view.height - h - 4)) + "px";
}

function tell(px, py) {
  const x = view.x + (px - view.width / 2) / view.scale, y = view.y - (py - view.height / 2) / view.scale;
  const by = D.sites.map((s) => [Math.hypot(x - s.x, y - s.y), s]).sort((a, b) => a[0] - b[0])[0];
  if (!by) return;
  const azimuth = ((Math.atan2(x - by[1].x, y - by[1].y) * 180) / Math.PI + 360) % 360;
  readout.textContent = `From ${by[1].name}: ${fixed(by[0] / NM, 1)} NM · ${fixed(by[0] / 1000, 1)} km, ${fixed(azimuth, 1).padStart(5, "0")}°`;
}

function zoom(factor, px, py) {
  const s = Math.max(1e-5, Math.min(view.scale * factor, 5));
  view.x += (px - view.width / 2) * (1 / view.scale - 1 / s);
  view.y -= (py - view.height / 2) * (1 / view.scale - 1 / s);
  view.scale = s;
  view.whole = false;
  repaint();
}

const pointers = new Map();
let moved = 0;
const at = (event) => { const box = map.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
map.addEventListener("pointerdown", (event) => { map.setPointerCapture(event.pointerId); pointers.set(event.pointerId, at(event)); moved = 0; });
map.addEventListener("pointermove", (event) => {
  const [px, py] = at(event), last = pointers.get(event.pointerId);
  if (last) {
    const other = [...pointers].find(([id]) => id !== event.pointerId);
    if (other) {
      const [ox, oy] = other[1];
      zoom(Math.hypot(px - ox, py - oy) / Math.max(Math.hypot(last[0] - ox, last[1] - oy), 1), (px + ox) / 2, (py + oy) / 2);
    } else {
      view.x -= (px - last[0]) / view.scale;
      view.y += (py - last[1]) / view.scale;
    }
    moved += Math.abs(px - last[0]) + Math.abs(py - last[1]);
    if (moved > 4) { view.whole = false; tip.hidden = true; }
    pointers.set(event.pointerId, [px, py]);
  } else {
    state.hover = pick(px, py);
    map.style.cursor = state.hover ? "pointer" : "";
    showTip(state.hover, px, py);
    tell(px, py);
  }
  repaint();
});
for (const name of ["pointerup", "pointercancel"]) map.addEventListener(name, (event) => {
  if (name === "pointerup" && moved <= 4) {
    const hit = pick(...at(event));
    if (hit && hit.update !== undefined) select(hit.track);
  }
  pointers.delete(event.pointerId);
});
map.addEventListener("pointerleave", () => { state.hover = null; tip.hidden = true; readout.textContent = ""; repaint(); });
map.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), ...at(event)); }, { passive: false });
map.addEventListener("dblclick", () => { fit(); view.whole = true; });
map.addEventListener("keydown", (event) => {
  const step = 60 / view.scale, moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
  if (moves[event.key]) { view.x += moves[event.key][0]; view.y += moves[event.key][1]; view.whole = false; repaint(); event.preventDefault(); }
  if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 1.3 : 1 / 1.3, view.width / 2, view.height / 2);
  if (event.key === "0") { fit(); view.whole = true; }
});
document.getElementById("fit").addEventListener("click", () => { fit(); view.whole = true; });
