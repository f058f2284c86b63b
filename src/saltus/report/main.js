// Wiring: cards, selection, tables and printing.

const side = document.getElementById("selected"), colour = document.getElementById("colour");
const sidePlot = element("canvas", {});
listen(sidePlot, () => state.selected);

function fact(name, value) {
  return element("div", {}, element("dt", {}, name), element("dd", {}, value));
}

function fillSide() {
  const track = TRACKS[state.selected];
  if (!track) {
    side.replaceChildren(element("p", { class: "none" }, TRACKS.length ? "Choose a track in the plan or in the table." : "There is no track to show."));
    return;
  }
  const pin = element("button", { type: "button" }, state.chosen.includes(state.selected) ? "Unpin" : "Pin below");
  pin.addEventListener("click", () => {
    const k = state.selected;
    state.chosen = state.chosen.includes(k) ? state.chosen.filter((c) => c !== k) : [...state.chosen, k];
    fillSide();
    fillGroups();
  });
  const facts = element("dl", { class: "facts" }, fact("Start", clock(U.t[track.first])), fact("Duration", lasting(track.duration)),
    fact("Updates", grouped(track.n)), fact("In manoeuvre", lasting(track.man)));
  const made = S ? [element("p", { class: "legend" }, ...systemsOf(state.selected).map((k) => element("span", {}, chip(k), " " + S.names[k])))] : [];
  side.replaceChildren(element("header", {}, element("b", {}, track.title), element("span", {}, track.text), pin), facts, ...made, element("div", { class: "plot" }, sidePlot));
}

let cards = [];
function card(k) {
  const track = TRACKS[k], canvas = element("canvas", {}), button = element("button", { type: "button" }, "Show in plan");
  const node = element("div", { class: "card" }, element("header", {}, element("b", {}, track.title), element("span", {}, track.text), button), element("div", { class: "plot" }, canvas));
  button.addEventListener("click", () => { select(k); document.getElementById("plan").scrollIntoView({ behavior: "smooth" }); });
  listen(canvas, () => k);
  cards.push({ k, canvas, node });
  return node;
}

function fillGroups() {
  const kinds = [["Pinned", state.chosen], ["Most manoeuvring", D.groups.manoeuvring], [D.groups.manoeuvring.length ? "Busiest of the others (most updates in motion)" : "Busiest (most updates in motion)", D.groups.busiest]];
  cards = [];
  const nodes = kinds.filter(([, list]) => list.length).map(([name, list]) =>
    element("div", { class: "group" }, element("h3", {}, name), element("div", { class: "cards" }, ...list.map(card))));
  document.getElementById("groups").replaceChildren(...(nodes.length ? nodes : [element("p", { class: "none" }, "No track was confirmed.")]));
  repaint();
}

painters.push(function paintCards() {
  const hovered = state.hover && state.hover.update;
  const cursor = (k) => (state.cursorTrack === k ? state.cursor : hovered !== undefined && hovered !== null && state.hover.track === k ? U.t[hovered] : NaN);
  if (TRACKS[state.selected]) paintTrack(sidePlot, TRACKS[state.selected], cursor(state.selected));
  for (const { k, canvas, node } of cards) {
    node.classList.toggle("current", k === state.selected);
    const box = node.getBoundingClientRect();
    const key = [cursor(k), canvas.clientWidth, canvas.clientHeight, sharpness].join();
    if (key === canvas.painted || (!sharpness && canvas.painted && (box.bottom < -200 || box.top > innerHeight + 200))) continue;
    paintTrack(canvas, TRACKS[k], cursor(k));
    canvas.painted = key;
  }
});

const list = document.getElementById("list");
function select(k) {
  state.selected = k;
  fillSide();
  if (S) fillMembers();
  if (list) for (const row of list.tBodies[0].rows) row.classList.toggle("current", +row.dataset.track === k);
  repaint();
}

for (const table of document.querySelectorAll("#list, .pick"))
  table.tBodies[0].addEventListener("click", (event) => {
    const row = event.target.closest("tr[data-track]");
    if (row) select(+row.dataset.track);
  });
if (list) {
  list.tHead.addEventListener("click", (event) => {
    const head = event.target.closest("th");
    if (!head) return;
    const column = head.cellIndex, up = head.getAttribute("aria-sort") !== "ascending", numeric = head.dataset.sort === "n";
    const value = (row) => (numeric ? +row.cells[column].dataset.v : row.cells[column].textContent);
    const rows = [...list.tBodies[0].rows].sort((a, b) => {
      const p = value(a), q = value(b);
      return (numeric ? p - q : p.localeCompare(q)) * (up ? 1 : -1);
    });
    for (const other of list.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    list.tBodies[0].append(...rows);
  });
}
const find = document.getElementById("find");
find.addEventListener("input", () => {
  const wanted = find.value.trim().toLowerCase();
  if (list) for (const row of list.tBodies[0].rows)
    row.hidden = wanted !== "" && ![0, 1, 2, 3].some((c) => row.cells[c].textContent.toLowerCase().includes(wanted));
});

for (const box of document.querySelectorAll("input[data-show]"))
  box.addEventListener("change", () => { state.show[box.dataset.show] = box.checked; repaint(); });
for (const box of document.querySelectorAll("input[data-show]")) state.show[box.dataset.show] = box.checked;

function paintRamp() {
  const ramp = state.colour === "height" ? D.colours.height : D.colours.p, canvas = document.getElementById("ramp"), ctx = canvas.getContext("2d");
  ramp.forEach((c, k) => { ctx.fillStyle = c; ctx.fillRect((k * canvas.width) / ramp.length, 0, canvas.width / ramp.length + 1, canvas.height); });
  const ends = state.colour === "height" ? HEIGHTS.map((h) => "FL " + String(Math.round(h / FL)).padStart(3, "0")) : ["0", "1"];
  document.getElementById("ramp-low").textContent = ends[0];
  document.getElementById("ramp-high").textContent = ends[1];
}
colour.addEventListener("change", () => { state.colour = colour.value; paintRamp(); repaint(); });
state.colour = colour.value; // a browser may restore the last choice
paintRamp();

addEventListener("resize", repaint);
addEventListener("scroll", repaint, { passive: true });
new ResizeObserver(repaint).observe(map.parentElement);
const paintAll = () => { for (const paint of painters) paint(); };
addEventListener("beforeprint", () => {
  document.documentElement.classList.add("printing");
  sharpness = 3;
  paintAll();
});
addEventListener("afterprint", () => {
  document.documentElement.classList.remove("printing");
  sharpness = 0;
  paintAll();
});

fillGroups();
const first = [...D.groups.manoeuvring, ...D.groups.busiest][0];
select(first === undefined ? -1 : first);
