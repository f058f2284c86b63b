// The strip under the plan: reports over time, and the window of time that is shown.

const strip = document.getElementById("strip"), grips = [document.getElementById("grip-a"), document.getElementById("grip-b")];
const windowText = document.getElementById("window"), AXIS = 18, LEAST = Math.min(1, SPAN);
const BIN = TIME_STEPS.find((s) => SPAN / s <= 240) || SPAN / 240;
document.getElementById("bin").textContent = BIN < 60 ? (BIN === 1 ? "second" : BIN + " s") : BIN < 3600 ? (BIN === 60 ? "minute" : BIN / 60 + " min") : fixed(BIN / 3600) + " h";
const HISTOGRAM = (() => {
  const bins = Array.from({ length: Math.max(Math.ceil(SPAN / BIN), 1) }, () => [0, 0]);
  for (let i = 0; i < P.t.length; i++) {
    if (P.t[i] < 0 || P.t[i] > SPAN) continue; // rejected, with a time of its own
    bins[Math.min(Math.floor(P.t[i] / BIN), bins.length - 1)][P.class[i] === 0 ? 0 : 1] += P.every;
  }
  return bins;
})();

const tx = (t, width) => (t / SPAN) * width;

painters.push(function paintStrip() {
  const place = prepare(strip);
  if (!place) return;
  const { ctx, width, height } = place, base = height - AXIS, most = Math.max(...HISTOGRAM.map(([a, b]) => a + b), 1);
  const [from, to] = state.window;
  ctx.fillStyle = "#f4f6f8";
  ctx.fillRect(0, 0, width, base);
  HISTOGRAM.forEach(([used, other], k) => {
    const x = tx(k * BIN, width), w = Math.max(Math.min(tx(BIN, width), width - x) - 0.6, 0.4), scale = (base - 5) / most;
    const inside = (k + 1) * BIN > from && k * BIN < to;
    ctx.fillStyle = inside ? "#8fa3b7" : "#d3dae1";
    ctx.fillRect(x, base - used * scale, w, used * scale);
    ctx.fillStyle = inside ? "#d48a34" : "#ecdcc7";
    ctx.fillRect(x, base - (used + other) * scale, w, other * scale);
  });
  ctx.strokeStyle = "#6d7b89";
  ctx.lineWidth = 1;
  ctx.strokeRect(tx(from, width) + 0.5, 0.5, Math.max(tx(to - from, width) - 1, 1), base - 1);
  ctx.fillStyle = SOFT;
  ctx.font = "11px " + FONT;
  ctx.textBaseline = "top";
  const marks = timeTicks(0, SPAN, Math.max(width / 80, 2));
  for (const t of marks.at) {
    const x = tx(t, width), half = ctx.measureText(clock(t, marks.seconds)).width / 2;
    ctx.fillRect(Math.round(x), base, 1, 4);
    ctx.textAlign = x < half ? "left" : x > width - half ? "right" : "center";
    ctx.fillText(clock(t, marks.seconds), x, base + 5);
  }
  ctx.textAlign = "left";
  ctx.font = "10.5px " + FONT;
  halo(ctx, String(grouped(most)), 9, 3, SOFT);
  grips.forEach((grip, k) => {
    grip.style.left = tx(state.window[k], width) + "px";
    grip.setAttribute("aria-valuetext", clock(state.window[k]));
    grip.setAttribute("aria-valuenow", String(Math.round(state.window[k])));
    grip.setAttribute("aria-valuemin", "0");
    grip.setAttribute("aria-valuemax", String(Math.round(SPAN)));
  });
  windowText.textContent = `${clock(from)} – ${clock(to)} UTC · ${lasting(to - from)}`;
});

function setWindow(from, to) {
  state.window = [Math.max(0, Math.min(from, SPAN - LEAST)), Math.min(SPAN, Math.max(to, LEAST))];
  if (state.window[1] - state.window[0] < LEAST) state.window[1] = state.window[0] + LEAST;
  repaint();
}

function drag(node, start) {
  node.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    if (node.focus) node.focus();
    node.setPointerCapture(event.pointerId);
    const width = strip.clientWidth, box = strip.getBoundingClientRect();
    const move = start(((event.clientX - box.left) / width) * SPAN);
    const onMove = (e) => move(((e.clientX - box.left) / width) * SPAN);
    node.addEventListener("pointermove", onMove);
    const stop = () => node.removeEventListener("pointermove", onMove);
    node.addEventListener("pointerup", stop, { once: true });
    node.addEventListener("pointercancel", stop, { once: true });
  });
}
drag(grips[0], () => (t) => setWindow(Math.min(t, state.window[1] - LEAST), state.window[1]));
drag(grips[1], () => (t) => setWindow(state.window[0], Math.max(t, state.window[0] + LEAST)));
// Inside a window the drag moves it; elsewhere, or where the window is everything, it draws a new one.
drag(strip, (t) => {
  const [from, to] = state.window;
  if (t >= from && t <= to && to - from < SPAN * 0.999)
    return (u) => { const d = Math.max(-from, Math.min(u - t, SPAN - to)); setWindow(from + d, to + d); };
  return (u) => { if (Math.abs(u - t) > SPAN / 400) setWindow(Math.min(t, u), Math.max(t, u)); };
});
strip.addEventListener("dblclick", () => setWindow(0, SPAN));
document.getElementById("all-time").addEventListener("click", () => setWindow(0, SPAN));
grips.forEach((grip, k) => grip.addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -1, ArrowRight: 1, PageDown: -10, PageUp: 10 }[event.key];
  if (!step) return;
  event.preventDefault();
  const next = [...state.window];
  next[k] += (step * SPAN) / 200;
  setWindow(...next);
}));
