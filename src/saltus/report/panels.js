// Height, speed, course and mode probabilities of one track over time, on one canvas.

const SLOW = 3 * KT; // below it a course is noise
const LEFT = 44, RIGHT = 48, TOP = 0, FOOT = 16;
const PANELS = [
  { name: "Height", left: "FL", right: "m", unit: FL, second: 1, weight: 1.15, least: 20, value: (i) => U.altitude[i], shade: "pv" },
  { name: "Speed", left: "kt", right: "m/s", unit: KT, second: 1, weight: 1, least: 40, value: (i) => U.speed[i], shade: "ph" },
  { name: "Course", left: "°", weight: 1, course: true, value: (i) => (U.speed[i] >= SLOW ? course(i) : NaN), shade: "ph" },
  { name: "P(manoeuvre)", left: "", weight: 0.8, chance: true },
];
const BANDS = { ph: "#f6dbe2", pv: "#d5ecea" };

// Updates of a track that carry a measurement, cut where it was coasted or silent.
function runs(track, value, jump = Infinity) {
  const out = [];
  let run = null;
  for (let i = track.first; i < track.end; i++) {
    const v = value(i);
    if (U.status[i] === COASTED || !Number.isFinite(v)) { run = null; continue; }
    if (run) {
      const last = run[run.length - 1];
      if (U.t[i] - last[0] > track.gap || Math.abs(v - last[1]) > jump) run = null;
    }
    if (!run) out.push((run = []));
    run.push([U.t[i], v]);
  }
  return out;
}

function range(panel, lines) {
  if (panel.chance) return [0, 1];
  if (panel.course) return lines.length ? [0, 360] : null;
  let low = Infinity, high = -Infinity;
  for (const line of lines) for (const [, v] of line) { low = Math.min(low, v / panel.unit); high = Math.max(high, v / panel.unit); }
  if (!(low <= high)) return null;
  const pad = Math.max((high - low) * 0.09, (panel.least - (high - low)) / 2, 0);
  const floor = low >= 0 ? Math.max(low - pad, -0.06 * (high + pad)) : low - pad;
  return [floor, Math.max(high + pad, floor + panel.least)];
}

function axis(ctx, panel, box, ends) {
  const y = (v) => box.y + box.h - ((v - ends[0]) / (ends[1] - ends[0])) * box.h;
  const marks = panel.course ? (box.h < 75 ? [0, 180, 360] : [0, 90, 180, 270, 360]) : panel.chance ? [0, 0.5, 1] : ticks(ends[0], ends[1], box.h / 21);
  ctx.font = "10.5px " + FONT;
  ctx.textBaseline = "middle";
  ctx.lineWidth = 1;
  for (const v of marks) {
    const level = Math.round(y(v)) + 0.5;
    ctx.strokeStyle = RULE;
    ctx.beginPath();
    ctx.moveTo(box.x, level);
    ctx.lineTo(box.x + box.w, level);
    ctx.stroke();
    ctx.fillStyle = SOFT;
    ctx.textAlign = "right";
    ctx.fillText(panel.course ? String(v).padStart(3, "0") : panel.chance ? (v === 0.5 ? "½" : v) : panel.left === "FL" ? (v < 0 ? "−" : "") + String(Math.abs(Math.round(v))).padStart(3, "0") : grouped(+v.toPrecision(6)), box.x - 6, level);
  }
  if (!panel.right) return y;
  const scale = panel.unit / panel.second;
  ctx.textAlign = "left";
  for (const v of ticks(ends[0] * scale, ends[1] * scale, box.h / 24)) {
    const level = Math.round(y(v / scale)) + 0.5;
    ctx.fillStyle = "#9aa5b0";
    ctx.fillRect(box.x + box.w, level - 0.5, 4, 1);
    ctx.fillStyle = SOFT;
    ctx.fillText(grouped(+v.toPrecision(6)), box.x + box.w + 7, level);
  }
  return y;
}

function bands(ctx, track, box, x, which) {
  ctx.fillStyle = BANDS[which];
  for (let i = track.first; i < track.end; i++) {
    if (U[which][i] === P_NONE || U[which][i] <= 125) continue;
    const before = i > track.first ? Math.min(U.t[i] - U.t[i - 1], track.gap) : 0;
    const from = Math.max(x(U.t[i] - before), box.x), to = Math.max(x(U.t[i]), from + 1);
    ctx.fillRect(from, box.y, to - from, box.h);
  }
}

function trace(ctx, lines, x, y, colour, unit = 1, width = 1.6) {
  ctx.strokeStyle = ctx.fillStyle = colour;
  ctx.lineWidth = width;
  ctx.lineJoin = "round";
  ctx.lineCap = "round";
  for (const line of lines) {
    ctx.beginPath();
    line.forEach(([t, v], k) => (k ? ctx.lineTo(x(t), y(v / unit)) : ctx.moveTo(x(t), y(v / unit))));
    ctx.stroke();
    if (line.length === 1) { ctx.beginPath(); ctx.arc(x(line[0][0]), y(line[0][1] / unit), 1.4, 0, 7); ctx.fill(); }
  }
}

function heading(ctx, panel, box, value) {
  ctx.font = "600 11px " + FONT;
  ctx.textBaseline = "alphabetic";
  ctx.textAlign = "left";
  ctx.fillStyle = INK;
  ctx.fillText(panel.name, box.x, box.y - 6);
  const name = ctx.measureText(panel.name).width;
  ctx.font = "10.5px " + FONT;
  ctx.fillStyle = SOFT;
  if (value) { ctx.textAlign = "center"; ctx.fillStyle = INK; ctx.fillText(value, box.x + box.w / 2 + name / 3, box.y - 6); ctx.fillStyle = SOFT; }
  ctx.textAlign = "right";
  ctx.fillText(panel.left, box.x - 6, box.y - 6);
  ctx.textAlign = "left";
  if (panel.right) ctx.fillText(panel.right, box.x + box.w + 7, box.y - 6);
}

function reading(panel, i) {
  if (panel.chance) return `horizontal ${fixed(probability(U.ph, i), 2)} · vertical ${fixed(probability(U.pv, i), 2)}`;
  const v = panel.value(i);
  if (panel.course) return degrees(v);
  return panel.left === "FL" ? level(v) : fixed(v / KT) + " kt · " + fixed(v) + " m/s";
}

function paintTrack(canvas, track, cursor) {
  const place = prepare(canvas);
  if (!place) return;
  const { ctx, width, height } = place, gap = 24, total = PANELS.reduce((s, p) => s + p.weight, 0);
  const from = U.t[track.first], to = Math.max(U.t[track.end - 1], from + 1), w = width - LEFT - RIGHT;
  const x = (t) => LEFT + ((t - from) / (to - from)) * w, room = height - FOOT - TOP - gap * PANELS.length;
  const at = Number.isFinite(cursor) && cursor >= from - 5 && cursor <= to + 5 ? nearest(track, cursor) : -1;
  canvas.time = (px) => from + ((px - LEFT) / w) * (to - from);
  let top = TOP;
  for (const panel of PANELS) {
    const box = { x: LEFT, y: top + gap - 6, w, h: (room * panel.weight) / total };
    top = box.y + box.h + 6;
    const lines = panel.chance ? [] : runs(track, panel.value, panel.course ? 180 : Infinity), ends = range(panel, lines);
    ctx.fillStyle = "#fbfcfd";
    ctx.fillRect(box.x, box.y, box.w, box.h);
    if (panel.shade) bands(ctx, track, box, x, panel.shade);
    heading(ctx, panel, box, at >= 0 ? reading(panel, at) : "");
    if (ends) {
      const y = axis(ctx, panel, box, ends);
      if (panel.chance) {
        trace(ctx, runs(track, (i) => probability(U.pv, i)), x, y, VERTICAL, 1, 1.2);
        trace(ctx, runs(track, (i) => probability(U.ph, i)), x, y, HORIZONTAL, 1, 1.4);
      } else trace(ctx, lines, x, y, LINE, panel.unit || 1);
    } else {
      ctx.fillStyle = SOFT;
      ctx.textAlign = "center";
      ctx.textBaseline = "middle";
      ctx.font = "11.5px " + FONT;
      ctx.fillText(panel.course ? "below 3 kt" : "not measured", box.x + box.w / 2, box.y + box.h / 2);
    }
    if (at >= 0) { ctx.fillStyle = "rgba(23,33,43,.55)"; ctx.fillRect(Math.round(x(U.t[at])), box.y, 1, box.h); }
  }
  timeAxis(ctx, from, to, x, w, top - 6);
}

function timeAxis(ctx, from, to, x, w, base) {
  const marks = timeTicks(from, to, Math.max(w / 62, 2));
  ctx.font = "10.5px " + FONT;
  ctx.textBaseline = "top";
  ctx.textAlign = "center";
  for (const t of marks.at) {
    ctx.fillStyle = "#9aa5b0";
    ctx.fillRect(Math.round(x(t)), base, 1, 4);
    ctx.fillStyle = SOFT;
    ctx.fillText(clock(t, marks.seconds), x(t), base + 6);
  }
}

function listen(canvas, index) {
  canvas.addEventListener("pointermove", (event) => {
    if (!canvas.time) return;
    state.cursor = canvas.time(event.clientX - canvas.getBoundingClientRect().left);
    state.cursorTrack = index();
    repaint();
  });
  canvas.addEventListener("pointerleave", () => { state.cursor = NaN; state.cursorTrack = -1; repaint(); });
}
