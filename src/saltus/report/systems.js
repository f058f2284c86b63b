// Several systems: the local tracks that made the selected track, and how probable each pair of them is.

const MOST_LOCAL = 16, FOOT_LOCAL = 18;

function chip(k) {
  const node = element("i", { class: "chip", title: S.names[k] }, String(k + 1));
  node.style.background = S.colours[k];
  return node;
}

// Rows of S.members of each track; pairs of each local track.
const MEMBERS = new Map(), PARTNERS = new Map();
if (S) {
  const note = (map, key, value) => (map.has(key) ? map.get(key).push(value) : map.set(key, [value]));
  for (let i = 0; i < S.members.track.length; i++) note(MEMBERS, S.members.track[i], i);
  for (let j = 0; j < S.pairs.a.length; j++) { note(PARTNERS, S.pairs.a[j], j); note(PARTNERS, S.pairs.b[j], j); }
}

const systemsOf = (k) => [...new Set((MEMBERS.get(k) || []).map((i) => S.local[S.members.local[i]][0]))].sort((a, b) => a - b);
const likely = (j) => {
  for (let i = S.pairs.first[j]; i < S.pairs.first[j + 1]; i++) if (S.pairs.p[i] !== P_NONE && S.pairs.p[i] >= 125) return true;
  return false;
};

// One row for each local track of a track, and for each that was probable with one of them and is not among them.
function localRows(k) {
  const rows = new Map();
  for (const i of MEMBERS.get(k) || []) {
    const local = S.members.local[i];
    if (!rows.has(local)) rows.set(local, { local, spells: [], pairs: [] });
    rows.get(local).spells.push([S.members.from[i], S.members.to[i], S.members.p[i] * 0.004]);
  }
  const own = [...rows.keys()];
  for (const local of own)
    for (const j of PARTNERS.get(local) || []) {
      const other = S.pairs.a[j] === local ? S.pairs.b[j] : S.pairs.a[j];
      if (own.includes(other)) rows.get(local).pairs.push({ j, other });
      else if (likely(j)) {
        if (!rows.has(other)) rows.set(other, { local: other, spells: [], pairs: [] });
        rows.get(other).pairs.push({ j, other: local });
      }
    }
  const begin = (row) => (row.spells.length ? row.spells[0][0] : 1e12 + S.pairs.t[S.pairs.first[row.pairs[0].j]]);
  return [...rows.values()].sort((a, b) => begin(a) - begin(b));
}

const chance = (all) => {
  const least = Math.min(...all);
  return "P " + (least > 0.99 ? "> 0.99" : (Math.max(...all) > least ? "≥ " : "") + least.toFixed(2));
};
const members = document.querySelector("#members");
let lanes = [];
function fillMembers() {
  const track = TRACKS[state.selected], rows = track ? localRows(state.selected) : [];
  lanes = [];
  if (!rows.length) {
    members.replaceChildren(element("p", { class: "none" }, "Choose a track in the plan or in a table."));
    return;
  }
  const nodes = rows.slice(0, MOST_LOCAL).map((row, n) => {
    const [system, name] = S.local[row.local], canvas = element("canvas", {});
    const said = !row.spells.length ? "not this object" : n ? chance(row.spells.map((s) => s[2])) : "first";
    listen(canvas, () => state.selected);
    lanes.push({ row, canvas, foot: n === Math.min(rows.length, MOST_LOCAL) - 1 });
    return element("div", { class: "lane" }, element("div", {}, chip(system), element("b", {}, name), element("span", {}, said)), canvas);
  });
  if (rows.length > MOST_LOCAL) nodes.push(element("p", { class: "note" }, `${rows.length - MOST_LOCAL} more local tracks are not shown.`));
  lanes[lanes.length - 1].canvas.classList.add("last");
  members.replaceChildren(element("header", {}, element("b", {}, track.title), element("span", {}, track.text + " · the local tracks it was made of")), ...nodes);
}

function paintLane({ row, canvas, foot }, track, cursor) {
  const place = prepare(canvas);
  if (!place) return;
  const { ctx, width } = place, height = place.height - (foot ? FOOT_LOCAL : 0), left = 22, w = width - left - 18;
  const from = U.t[track.first], to = Math.max(U.t[track.end - 1], from + 1);
  const x = (t) => left + Math.min(Math.max((t - from) / (to - from), 0), 1) * w, y = (p) => 4 + (1 - p) * (height - 8);
  canvas.time = (px) => from + ((px - left) / w) * (to - from);
  ctx.fillStyle = "#fbfcfd";
  ctx.fillRect(left, 0, w, height);
  ctx.fillStyle = S.colours[S.local[row.local][0]];
  ctx.globalAlpha = 0.13;
  for (const [a, b] of row.spells) ctx.fillRect(x(a), 0, Math.max(x(b) - x(a), 1), height);
  ctx.globalAlpha = 1;
  ctx.font = "10.5px " + FONT;
  ctx.textBaseline = "middle";
  ctx.textAlign = "right";
  for (const [p, text] of [[0, "0"], [1, "1"]]) {
    ctx.fillStyle = RULE;
    ctx.fillRect(left, Math.round(y(p)), w, 1);
    ctx.fillStyle = SOFT;
    ctx.fillText(text, left - 6, y(p) + (p ? 3 : -2));
  }
  for (const { j, other } of row.pairs) paintPair(ctx, j, x, y, S.colours[S.local[other][0]], row.spells.length === 0);
  ctx.fillStyle = "rgba(23,33,43,.55)";
  if (cursor >= from && cursor <= to) ctx.fillRect(Math.round(x(cursor)), 0, 1, height);
  if (foot) timeAxis(ctx, from, to, x, w, height);
}

// A probability holds until the next one.
function paintPair(ctx, j, x, y, colour, dashed) {
  const { t, p, first } = S.pairs;
  ctx.strokeStyle = colour;
  ctx.lineWidth = 1.6;
  ctx.setLineDash(dashed ? [4, 3] : []);
  ctx.beginPath();
  for (let i = first[j], on = false; i < first[j + 1]; i++) {
    const v = y(p[i] * 0.004);
    if (on) ctx.lineTo(x(t[i]), y(p[i - 1] * 0.004));
    if (p[i] === P_NONE) { on = false; continue; }
    if (on) ctx.lineTo(x(t[i]), v);
    else ctx.moveTo(x(t[i]), v);
    on = true;
  }
  ctx.stroke();
  ctx.setLineDash([]);
}

painters.push(function paintMembers() {
  const track = TRACKS[state.selected];
  if (S && track) for (const lane of lanes) paintLane(lane, track, state.cursorTrack === state.selected ? state.cursor : NaN);
});
