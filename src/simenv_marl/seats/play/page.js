"use strict"; // The page of a seat, or of a spectator. All texts of the game become text nodes, never markup.

const $ = (id) => document.getElementById(id);
const seat = location.pathname.startsWith("/seat/") ? decodeURIComponent(location.pathname.slice(6)) : "";
const key = new URLSearchParams(location.search).get("key") || "";
let socket, state = null, fan = null, people = { taken: {}, spectators: 0 }, widget = null, drawn = "", arrived = 0, names = {};

const show = (value) => typeof value === "number" ? (Number.isInteger(value) ? String(value) : String(+value.toPrecision(3)))
  : Array.isArray(value) ? value.map(show).join(", ") : typeof value === "string" ? value : JSON.stringify(value);
const name = (action) => action === null ? "the rule"
  : (state.pending?.space.kind === "discrete" && state.pending.labels?.[action]) || show(action);
const mine = () => Boolean(seat && state.pending && state.pending.agent === seat);
const seen = () => mine() || Boolean(!seat && state.pending); // also by a spectator, who decides nothing
const send = (message) => socket.readyState === 1 && socket.send(JSON.stringify({ ...message, seat, key }));
const decide = (message) => mine() && send({ turn: state.turn, ...message });
const act = (action) => decide(action === null ? { do: "rule" } : { do: "act", action });
const problem = (text) => { $("problem").textContent = text; $("problem").hidden = !text; };

function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

function draw(label, ...parts) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const set = (element, values) => Object.entries(values).forEach((pair) => element.setAttribute(...pair));
  set(svg, { viewBox: "0 0 100 40", preserveAspectRatio: "none", role: "img", "aria-label": label });
  for (const [tag, points] of parts) {
    svg.append(document.createElementNS(svg.namespaceURI, tag));
    set(svg.lastChild, { points: points.join(" ") });
  }
  return svg;
}

function scale(values) { // to the height of a drawing
  const low = Math.min(...values), high = Math.max(...values);
  return (value) => 38 - 36 * (high > low ? (value - low) / (high - low) : 0.5);
}

// -- inputs: an element, and functions that get and set the JSON of the action -----------------------

function boxInput(low, high, whole, label, labels) {
  if (Array.isArray(low)) {
    const parts = low.map((part, i) => boxInput(part, high[i], whole, labels?.[i] ?? (low.length > 1 ? `${label}[${i}]` : label)));
    return { element: make("div", {}, ...parts.map((part) => part.element)), get: () => parts.map((part) => part.get()),
      set: (values) => parts.forEach((part, i) => part.set(values[i])) };
  }
  const bounded = typeof low === "number" && typeof high === "number" && high - low < 1e12, limits = bounded ? { min: low, max: high } : {};
  const middle = bounded ? (whole ? Math.round((low + high) / 2) : (low + high) / 2) : 0;
  const number = make("input", { type: "number", step: whole ? 1 : "any", ...limits, value: middle });
  const slider = make("input", { type: "range", step: whole ? 1 : "any", ...limits, value: middle, ariaLabel: `${label}, slider` });
  slider.oninput = () => { number.value = +Number(slider.value).toPrecision(3); };
  number.oninput = () => { slider.value = number.value; };
  const range = bounded ? [" ", make("span", { className: "range" }, show(low), slider, show(high))] : [];
  const element = make("div", {}, make("label", {}, `${label} `, number), ...range);
  return { element, get: () => number.value === "" ? "" : Number(number.value), set: (value) => { number.value = slider.value = value; } };
}

function gridInput({ sizes, starts }, mask, labels) {
  const parts = sizes.map((size, i) => [...Array(size).keys()].map((j) =>
    make("input", { type: "radio", name: `part${i}`, value: j + starts[i], disabled: Boolean(mask && !mask[i][j]) })));
  parts.forEach((radios) => { radios.find((radio) => !radio.disabled).checked = true; });
  const texts = (radios) => radios.map((radio) => make("label", { className: "pick" }, radio, ` ${radio.value}`));
  return { element: make("div", {}, ...parts.map((radios, i) => make("fieldset", {}, make("legend", {}, labels?.[i] ?? `Part ${i}`), ...texts(radios)))),
    get: () => parts.map((radios) => Number(radios.find((radio) => radio.checked).value)),
    set: (values) => parts.forEach((radios, i) => radios.forEach((radio) => { radio.checked = +radio.value === values[i]; })) };
}

function inputFor(space, mask, labels) {
  if (space.kind === "box" && [space.low].flat(9).length <= 64) return boxInput(space.low, space.high, space.whole, "Action", labels);
  if (space.kind === "grid" && space.sizes.length <= 64) return gridInput(space, mask, labels);
  const text = make("textarea", { rows: 3 }), element = make("label", {}, `The action, as JSON: ${space.text || "numbers"}`, text);
  return { element, get: () => JSON.parse(text.value), set: (value) => { text.value = JSON.stringify(value); } };
}

// -- the pending decision --------------------------------------------------------------------------

function actionButton(action, text, shortcut, disabled = false) {
  const label = make("span", {}, ...(shortcut ? [make("kbd", {}, shortcut), " "] : []), text);
  const button = make("button", { disabled }, label, make("span"));
  button.onclick = () => { if (widget && action !== null) widget.set(action); else act(action); };
  button.dataset.action = JSON.stringify(action);
  $("actions").append(button);
  return button;
}

function drawDecision() {
  const { space, mask, doc, agent, labels } = state.pending, few = space.kind === "discrete" && space.n <= 200;
  [$("whose").textContent, $("doc").textContent] = [`Decide for ${agent}`, doc];
  for (const id of ["inputs", "actions"]) $(id).replaceChildren();
  widget = few ? null : inputFor(space, mask, labels);
  for (let i = 0; few && i < space.n; i++)
    actionButton(i + space.start, name(i + space.start), i < 10 ? String((i + 1) % 10) : "", Boolean(mask && !mask[i]));
  if (widget) {
    const submit = (what) => { try { decide({ do: what, action: widget.get() }); } catch { problem("This is not JSON."); } };
    const go = make("button", { className: "go", onclick: () => submit("act") }, "Decide ", make("kbd", {}, "Enter"));
    widget.element.onkeydown = (event) => { if (event.key === "Enter" && !event.repeat) { event.preventDefault(); submit("act"); } };
    $("inputs").append(widget.element, go, " ", make("button", { onclick: () => submit("try") }, "What then?"));
  }
  actionButton(null, "The rule", "r");
}

function drawFans() {
  if (!fan || !seen() || fan.turn !== state.turn) return;
  $("note").textContent = fan.note;
  if (document.activeElement !== $("horizon")) $("horizon").value = fan.horizon;
  const last = fan.horizon - 1, of = Math.max(0, fan.measures.indexOf($("of").value));
  if ($("of").children.length !== fan.measures.length || $("of").dataset.agent !== state.pending.agent) {
    $("of").replaceChildren(...fan.measures.map((one) => make("option", {}, one)));
    $("of").dataset.agent = state.pending.agent;
  }
  const shown = fan.candidates.filter(({ bands }) => bands.length).map((one) => ({ ...one, bands: one.bands[of] }));
  const y = scale(shown.flatMap(({ bands }) => bands.flat())), buttons = [...$("actions").children];
  for (const { action, bands: [below, middle, above], n } of shown) {
    const button = buttons.find((one) => one.dataset.action === JSON.stringify(action)) || actionButton(action, name(action), "");
    const text = `${show(middle[last])} (${show(below[last])} to ${show(above[last])})`;
    const line = (band) => (last ? band : [band[0], band[0]]).map((value, i) => [100 * i / (last || 1), y(value)]);
    const label = `${fan.measures[of]} after ${fan.horizon} decisions: median ${text}, ${n} futures`;
    button.lastChild.replaceChildren(
      draw(label, ["polygon", [...line(below), ...line(above).reverse()]], ["polyline", line(middle)]), make("span", { className: "dim" }, text));
  }
  if (!("rule" in fan)) return;
  for (const button of $("actions").children) button.classList.toggle("isrule", button.dataset.action === JSON.stringify(fan.rule));
  $("actions").querySelector('[data-action="null"] > span').lastChild.textContent = `The rule: ${name(fan.rule)}`;
}

// -- what was seen and decided -----------------------------------------------------------------------

function drawCharts() {
  const agent = seat || (state.pending || state.history.at(-1) || {}).agent, now = state.pending?.agent === agent;
  if (state.pending) names[state.pending.agent] = state.pending.observation; // the latest one of each agent
  const rows = state.history.filter((row) => row.agent === agent);
  $("seen").textContent = agent ? `What ${agent} ${now ? "sees" : "saw"}` : "";
  $("charts").replaceChildren(...(names[agent] || []).map(([label, value], i) => {
    const past = rows.map((row) => row.values[i]).filter((one) => typeof one === "number"), y = scale(past);
    const card = make("div", {}, make("span", { className: "dim" }, label), make("div", {}, make("b", {}, show(past.at(-1) ?? value))));
    const line = past.map((one, j) => [100 * j / (past.length - 1), y(one)]);
    if (past.length > 1) card.append(draw(`${label}: the last ${past.length} values`, ["polyline", line]));
    return card;
  }));
}

function drawWay() {
  const rows = state.history.filter((row) => "action" in row && row.turn < state.turn).slice(-12).reverse();
  const cells = ({ turn, agent, action, by, reward }) =>
    [turn, agent, action === null ? "rule" : agent === seat && mine() ? name(action) : show(action), by, reward ?? ""];
  $("rows").replaceChildren(...rows.map((row) => make("tr", {}, ...cells(row).map((cell) => make("td", {}, show(cell))))));
  Object.assign($("jump"), { max: state.length, value: state.turn });
  $("turn").textContent = `${state.turn} of ${state.length}`;
  [$("undo").disabled, $("redo").disabled, $("controls").hidden] = [state.turn === 0, state.turn >= state.length, !seat];
}

function drawHead() {
  const { pending, over, seats, returns, seed, late } = state;
  const status = over ? `The episode is over: ${over}.` : !pending ? "…" : mine() ? `Your decision no. ${pending.number}` : `Waiting for ${pending.agent}`;
  if ($("status").textContent !== status) $("status").textContent = status;
  document.title = `${mine() ? "● " : ""}${state.simulation}`;
  $("name").textContent = `${state.simulation} — ${seat || "spectator"}`;
  const left = state.left === null ? "" : `, ${Math.max(0, Math.ceil(state.left - (Date.now() - arrived) / 1000))} s left`;
  const time = pending && pending.time !== null ? `, time ${show(pending.time)}` : "";
  const each = seats.slice(0, 12).map((one) => `${one}${people.taken[one] ? "" : " (free)"} ${show(returns[one] ?? 0)}` +
    (late[one] ? ` (${late[one]} late)` : ""));
  $("facts").textContent = `Decision ${state.turn}${time}, seed ${seed}${left}. ` +
    `${mine() ? `Last reward ${show(pending.reward)}. ` : ""}Returns: ${each.join(", ")}. ${people.spectators} watching.`;
}

function drawState() {
  const current = seen() ? JSON.stringify([state.seed, state.turn, state.pending.seen]) : "", { picture } = state;
  problem(state.notice);
  [$("decision").hidden, $("decision").inert] = [!current, !mine()];
  if (current && current !== drawn) {
    drawDecision();
    const first = $("decision").querySelector("input:enabled, textarea, #actions button:enabled");
    if (document.activeElement === document.body) first?.focus({ preventScroll: true });
  }
  drawn = current;
  for (const drawPart of [drawHead, drawFans, drawCharts, drawWay]) drawPart();
  [$("picture").hidden, $("text").hidden, $("image").hidden] = [!picture, !picture?.text, !picture?.png];
  $("text").textContent = picture?.text ?? "";
  if (picture?.png) $("image").src = `data:image/png;base64,${picture.png}`;
  if (document.activeElement !== $("seed")) $("seed").value = state.seed;
}

// -- connection and controls ---------------------------------------------------------------------------

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
  socket.onopen = () => { if (seat) send({ do: "take" }); };
  socket.onclose = () => { $("status").textContent = "The connection is lost; trying again …"; setTimeout(connect, 1000); };
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "state") { state = message; arrived = Date.now(); drawState(); }
    if (message.type === "fan") { fan = message; drawFans(); }
    if (message.type === "people") { people = message; drawHead(); }
    if (message.type === "error") problem(message.text);
  };
}

const number = (id) => Number.parseInt($(id).value, 10);
for (const id of ["undo", "redo", "skip"]) $(id).onclick = () => send({ do: id });
for (const [id, input] of [["delegate", "many"], ["restart", "seed"]]) $(id).onclick = () => send({ do: id, n: number(input) });
$("of").onchange = drawFans;
for (const id of ["horizon", "jump"]) $(id).onchange = () => send({ do: id, n: number(id) });
$("stop").onclick = () => send({ do: "delegate", n: 0 });
$("jump").oninput = () => { $("turn").textContent = `${$("jump").value} of ${state.length}`; };
document.onkeydown = (event) => {
  if (event.repeat && event.key === "Enter") event.preventDefault(); // each decision is one press
  if (!seat || !state || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, textarea")) return;
  if (event.key === "r") act(null);
  if (event.key === "u" || event.key === "y") $(event.key === "u" ? "undo" : "redo").click();
  if (/^\d$/.test(event.key) && mine() && !widget) $("actions").children[(+event.key + 9) % 10]?.click();
};
setInterval(() => { if (state && state.left !== null) drawHead(); }, 500); connect();
