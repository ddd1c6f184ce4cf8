// What the page shows of the game. It is drawn anew from the latest messages.

import { $, fanChart, draw, across, make, scale, show, signed, spark } from "./charts.js";
import { Answers, same } from "./inputs.js";
import { page } from "./link.js";

const FEW = 8; // the entries of a situation that are seen at first
const BY = { person: "", rule: "rule", policy: "policy", limit: "rule, as time was up" };

let answers = null, drawn = ""; // the inputs, and of which decision

export const current = () => answers;
export const mine = () => Boolean(page.seat && page.state?.pending?.agent === page.seat);
const inLobby = () => page.path === "/" && !page.key;
const isDead = () => page.lost || page.busy;

export function drawPage(touched) {
  const { state } = page;
  $("event").hidden = $("clock").hidden = true;
  const ready = state && !page.stranger && (!page.key || page.seat !== null);
  document.querySelector("main").hidden = !ready;
  if (!ready) { $("status").textContent = page.stranger || (page.lost ? "The connection is lost. Trying again …" : "Connecting …"); return; }
  document.querySelector("main").inert = isDead();
  document.body.classList.toggle("dead", isDead());
  for (const part of [drawHead, drawStatus, drawClock, drawLobby]) part();
  for (const id of ["decision", "end", "more"]) $(id).hidden = inLobby();
  if (inLobby()) return;
  for (const part of [drawDecision, drawFutures, drawEnd, drawLatest, drawPicture, drawTools, drawPast]) part(touched);
}

// -- the head ------------------------------------------------------------------------------------------

function drawHead() {
  const { state, seat } = page;
  $("title").textContent = state.title;
  $("seat").textContent = inLobby() ? "" : seat || (seat === "" ? "facilitator" : "watching");
  const points = inLobby() ? undefined : state.returns[seat];
  $("standing").textContent = points === undefined ? "" : `${show(points)} points`;
  document.title = `${mine() ? "● " : ""}${state.title}`;
  const second = seat && page.people.taken[seat] > 1 ? `This seat is open in ${page.people.taken[seat]} pages. ` : "";
  const event = second + (state.event || "");
  [$("event").textContent, $("event").hidden] = [event, !event];
  if (state.notice && !$("problem").dataset.error) [$("problem").textContent, $("problem").hidden] = [state.notice, false];
}

function waiting() {
  const { agent } = page.state.pending, who = page.people;
  if (!page.state.seats.includes(agent)) return `${agent} decides …`;
  if (who.taken[agent]) return `Waiting for ${agent} …`;
  return `Waiting for ${agent} … ${who.opened.includes(agent) ? "Its page is closed." : "Nobody has opened its link yet."}`;
}

function drawStatus() {
  const { state } = page;
  const text = page.lost ? "The connection is lost. Trying again …"
    : page.busy ? "The simulation computes …"
    : inLobby() || state.over ? ""
    : !state.pending ? "The simulation computes …"
    : mine() ? "" : waiting();
  if ($("status").textContent !== text) $("status").textContent = text;
  $("status").hidden = !text;
}

export function secondsLeft() {
  const { state, arrived } = page;
  if (!state || state.left === null || state.over || page.lost) return null;
  return Math.max(0, Math.ceil(state.left - (Date.now() - arrived) / 1000));
}

export function drawClock() {
  const left = secondsLeft();
  $("clock").hidden = left === null || inLobby();
  $("clock").textContent = left === null ? "" : `${left} s`;
  $("clock").classList.toggle("late", left !== null && left <= 10);
}

// -- the lobby -----------------------------------------------------------------------------------------

function drawLobby() {
  $("lobby").hidden = !inLobby();
  if (!inLobby()) return;
  const { state, people } = page;
  const rows = state.seats.map((seat) => {
    const taken = people.taken[seat], free = people.open && !taken;
    const who = taken ? "somebody sits there" : people.opened.includes(seat) ? "the page is closed" : "free";
    const take = make("button", { className: "take", disabled: !free }, "Take");
    take.dataset.seat = seat;
    const how = free ? take : make("span", { className: "dim" }, taken ? "taken" : "needs its link");
    return make("li", {}, make("b", {}, seat), " ", make("span", { className: "dim" }, who), " ", how);
  });
  for (const [agent, policy] of Object.entries(state.policies))
    if (!state.seats.includes(agent)) rows.push(make("li", {}, make("b", {}, agent), " ", make("span", { className: "dim" }, `the policy ${policy}`)));
  $("seats").replaceChildren(...rows);
}

// -- the situation ---------------------------------------------------------------------------------------

function drawSituation(place, entries) {
  const row = ({ label, text, past }) => make("div", { className: "entry" }, make("dt", {}, label),
    make("dd", {}, past.length > 1 ? spark(label, past) : "", make("b", {}, text.replace(/^-/, "−"))));
  const rows = entries.map(row), rest = rows.splice(FEW);
  place.replaceChildren(...rows);
  if (rest.length) place.append(make("details", {}, make("summary", {}, `${rest.length} more`), ...rest));
}

function drawLatest() {
  const { state, seat } = page;
  const agent = seat || state.history.at(-1)?.agent, view = state.views[agent];
  $("latest").hidden = !view || (state.pending && !$("decision").hidden);
  if ($("latest").hidden) return;
  $("whose").textContent = `${seat ? "Your situation" : `The situation of ${agent}`} at the latest decision${view.when ? `, ${view.when}` : ""}`;
  drawSituation($("seen"), view.situation);
}

// -- the pending decision --------------------------------------------------------------------------------

function drawDecision(touched) {
  const { state } = page, { pending } = state;
  const seen = Boolean(pending && (mine() || !page.seat));
  $("decision").hidden = !seen;
  const decision = seen ? `${state.seed} ${state.moment}` : "";
  if (seen && decision !== drawn) {
    $("question").textContent = pending.question || `Decide for ${pending.agent}`;
    drawSituation($("situation"), state.views[pending.agent].situation);
    answers = new Answers(pending.form, mine() ? pending.last : null, mine(), touched);
    $("problem").hidden = !state.notice;
    delete $("problem").dataset.error;
    setTimeout(focusFirst); // until then, the page is inert
  }
  if (!seen) answers = null;
  drawn = decision;
  $("decision").classList.toggle("watched", !mine());
  $("commit").hidden = !mine();
  $("what").hidden = !answers?.fields.length;
  if (answers && mine()) drawDecide();
}

export function drawDecide() {
  const ready = answers.chosen !== undefined || (answers.fields.length > 0 && !answers.isEmpty);
  $("decide").disabled = !ready || isDead();
  $("decide").classList.toggle("ready", ready);
  $("decide").replaceChildren(page.busy ? "The simulation computes …" : "Decide", ...(answers.touched && ready ? [" ", make("kbd", {}, "Enter")] : []));
}

function focusFirst() {
  const input = answers?.fields[0]?.input;
  const rests = document.activeElement === document.body || !document.activeElement.isConnected
    || $("decision").contains(document.activeElement);
  if (input && mine() && rests) { input.focus({ preventScroll: true }); input.select?.(); }
  else if (mine() && rests) document.activeElement.blur();
}

// -- the futures -----------------------------------------------------------------------------------------

function spanOf({ horizon, by_time }) {
  const unit = by_time ? page.state.time_unit || "unit of time" : "decision";
  const plural = unit.replace(/^(\w+)/, horizon === 1 ? "$1" : "$1s");
  return `${show(horizon)} ${plural}`;
}

function legendOf(fan, shown, label, y, allSame) {
  const of = Math.max(...shown.map(({ n }) => n)), single = of === 1;
  if (!fan.done && !of) return "The futures are computed …";
  const after = `${label} after ${spanOf(fan)}`;
  const ends = y.low < y.high ? ` The charts go from ${show(y.low)} to ${show(y.high)}.` : "";
  const going = fan.done ? "" : ` Computing … ${of} of 16.`;
  const note = fan.note ? ` ${fan.note}` : "";
  if (allSame !== null) {
    const low = show(Math.min(...shown.map(({ band }) => band[0].at(-1)))), high = show(Math.max(...shown.map(({ band }) => band[2].at(-1))));
    const range = low === high ? "" : ` (8 of 10 futures: ${low} to ${high})`;
    return `${after}: ${show(allSame)}${range}, whatever you answer.${going}${note}`;
  }
  const middle = single ? "one future" : `the middle of ${of} futures; 8 of 10 lie in the band`;
  return `${after}: ${middle}.${ends}${going}${note}`;
}

function drawFutures() {
  const { fan, state } = page;
  if (!answers) return;
  const isCurrent = fan && fan.moment === state.moment;
  $("candidates").hidden = !isCurrent && !state.pending.form.fields;
  if (!isCurrent) { $("legend").textContent = ""; return; }
  const of = Math.max(0, fan.measures.indexOf($("of").value)), label = fan.measures[of];
  const shown = fan.candidates.filter(({ bands }) => bands.length).map((one) => ({ ...one, band: one.bands[of] }));
  const name = of ? label : "Your points";
  if (!shown.length) { $("legend").textContent = legendOf(fan, [{ n: 0 }], name, {}, null); return; }
  const y = scale(shown.flatMap(({ band }) => band.flat()));
  const ends = shown.map(({ band }) => band[1].at(-1)), best = Math.max(...ends), worst = Math.min(...ends);
  const close = 1e-3 * Math.max(Math.abs(best), Math.abs(worst), 1e-9);
  const allSame = shown.length === fan.candidates.length && best - worst <= close ? best : null;
  const rule = shown.find(({ action }) => action === null)?.band[1].at(-1);
  const twin = "rule" in fan ? shown.find(({ action }) => action !== null && same(action, fan.rule)) : null;
  $("legend").textContent = legendOf(fan, shown, name, y, allSame);
  for (const { action, words, band, n } of shown) {
    const entry = answers.cards.get(JSON.stringify(action)) || answers.card(action, words, "", $("candidates"));
    const end = band[1].at(-1), isRule = action === null;
    entry.card.classList.toggle("best", allSame === null && of === 0 && best - end <= close && !(isRule && twin));
    entry.card.classList.toggle("isrule", twin?.action === action && !isRule);
    if (isRule && fan.rule_words) entry.name.textContent = `By the rule: ${fan.rule_words.replace(/^[^:]*: (?=[^,]*$)/, "")}`;
    if (!isRule && !state.pending.form.cards) entry.name.textContent = words.replace(/^[^:]*: (?=[^,]*$)/, "");
    if (allSame !== null || (isRule && twin)) { entry.chart.replaceChildren(); continue; }
    const [low, high] = [show(band[0].at(-1)), show(band[2].at(-1))];
    const few = n > 1 && low !== high ? ` (${low} to ${high})` : "";
    const less = isRule || rule === undefined || Math.abs(end - rule) <= close ? "" : `${signed(+(end - rule).toPrecision(3))} than the rule`;
    const more = less.startsWith("+") ? less.slice(1).replace("than", "more than") : less.slice(1).replace("than", "less than");
    const text = make("span", { className: "dim" }, make("b", {}, show(end)), few, less ? `, ${more}` : "");
    entry.chart.replaceChildren(fanChart(`${name} after ${spanOf(fan)}: ${show(end)}${few}`, band, y, n === 1), text);
  }
  if (answers.active && answers.isEmpty && !answers.touched && fan.rule !== undefined && answers.fields.length) {
    answers.fill(fan.rule);
    drawDecide();
  }
}

export function drawMeasures() {
  const { fan } = page;
  const options = [...$("of").options].map((one) => one.value);
  if (!same(options, fan.measures)) $("of").replaceChildren(...fan.measures.map((one) => make("option", {}, one)));
  if (document.activeElement !== $("horizon")) $("horizon").value = fan.horizon ?? "";
  if (document.activeElement !== $("by")) $("by").value = fan.by_time ? "time" : "decisions";
  if (document.activeElement !== $("hold")) $("hold").value = fan.hold ?? "";
  $("by").disabled = page.state?.pending?.time === null;
}

// -- the end -----------------------------------------------------------------------------------------------

function drawEnd() {
  const { state, rule } = page;
  $("end").hidden = !state.over;
  if (!state.over) return;
  $("ending").textContent = state.ending;
  const compared = rule?.moment === state.moment ? rule : null;
  const rows = Object.entries(state.courses).map(([seat, course]) => {
    const other = compared?.courses[seat] ?? [], y = scale([...course, ...other]);
    const chart = course.length > 1 ? draw(`The points of ${seat}, and of the rule`,
      ["polyline", across(other, y), "other"], ["polyline", across(course, y)]) : "";
    const cells = [seat === page.seat ? `${seat} (you)` : seat, make("b", {}, show(state.returns[seat] ?? 0)),
      compared ? show(compared.totals[seat] ?? 0) : "…", chart];
    return make("tr", {}, ...cells.map((cell) => make("td", {}, cell)));
  });
  $("totals").replaceChildren(...rows);
  const ordinary = ["terminated", "truncated"].includes(state.over);
  $("compared").textContent = !ordinary ? "" : compared?.note
    || (compared ? "The rule: the same game, seed and others, if the rule had decided for all people (dashed)."
      : "The rule plays the same game to compare …");
  $("again").hidden = !(page.seat || page.seat === "") || (state.tools === "facilitator" && page.seat !== "");
}

// -- everything else ---------------------------------------------------------------------------------------

function drawPicture() {
  const { picture } = page.state;
  [$("picture").hidden, $("text").hidden, $("image").hidden] = [!picture, !picture?.text, !picture?.png];
  $("text").textContent = picture?.text ?? "";
  if (picture?.png) $("image").src = `data:image/png;base64,${picture.png}`;
}

function drawTools() {
  const { state, seat } = page;
  $("tools").hidden = !(state.tools === "all" ? seat : seat === "" && state.tools === "facilitator");
  Object.assign($("jump"), { max: state.length, value: state.turn });
  $("turn").textContent = `${Math.min(state.turn + 1, Math.max(1, state.length))} of ${Math.max(1, state.length)}`;
  [$("undo").disabled, $("redo").disabled] = [state.turn === 0, state.turn >= state.length && !state.back];
  if (page.fan?.moment === state.moment) drawMeasures();
}

function drawPast() {
  const { state } = page, rows = state.history.slice(-12).reverse();
  $("past").hidden = !rows.length;
  const cells = ({ turn, agent, words, by, reward, when }) => [
    make("span", {}, String(turn + 1), ...(when ? [make("span", { className: "dim" }, ` ${when}`)] : [])),
    agent, words || "by the rule", BY[by] ?? by, reward === null ? "" : show(reward)];
  $("rows").replaceChildren(...rows.map((row) => make("tr", {}, ...cells(row).map((cell) => make("td", {}, cell)))));
  const { seats, returns, late, seed, policies } = state, { taken, spectators } = page.people;
  const each = seats.slice(0, 12).map((one) => `${one} ${show(returns[one] ?? 0)}${late[one] ? ` (${late[one]} decided by the limit)` : ""}`);
  const others = Object.entries(policies).filter(([agent]) => !seats.includes(agent)).slice(0, 12).map(([agent, policy]) => `${agent}: policy ${policy}`);
  const watching = spectators ? ` ${spectators} watching.` : "";
  const open = seats.filter((one) => !taken[one]).slice(0, 12);
  $("facts").textContent = `${state.over ? "" : `Decision ${state.turn + 1}. `}Points: ${each.join(", ")}. ` +
    `${others.length ? `${others.join(", ")}. ` : ""}${open.length ? `Not here: ${open.join(", ")}. ` : ""}Seed ${seed}.${watching}`;
}
