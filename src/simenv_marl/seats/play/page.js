// The page of a seat, of the facilitator, of a spectator, or of the lobby.

"use strict";

import { $ } from "./charts.js";
import { connect, move, page, send } from "./link.js";
import { current, drawClock, drawDecide, drawPage, mine, secondsLeft } from "./view.js";

const touched = () => { complain(""); drawDecide(); };
const redraw = () => drawPage(touched);

function complain(text) {
  [$("problem").textContent, $("problem").hidden] = [text, !text];
  if (text) $("problem").dataset.error = "yes";
  else delete $("problem").dataset.error;
}

// -- messages ------------------------------------------------------------------------------------------

connect((kind, message) => {
  if (kind === "error" && !message.stranger) complain(message.text);
  redraw();
});

function moved(message) {
  if (!move(message)) return;
  complain("");
  redraw();
}

// -- deciding ------------------------------------------------------------------------------------------

// deliberate: whether a pointer has clicked on the button; a key counts after something was touched.
function decide(deliberate) {
  const answers = current();
  if (!mine() || !answers) return;
  if (!answers.touched && !deliberate) { complain("Choose or change something first."); return; }
  const message = answers.message();
  if (message) moved({ ...message, turn: page.state.turn });
}

$("decide").onclick = (event) => decide(event.detail === 1);
$("what").onclick = () => {
  const message = current()?.message();
  if (message?.do === "act" && !page.busy) send({ do: "try", action: message.action, turn: page.state.turn });
};

document.onkeydown = (event) => {
  const { key, target } = event;
  if (event.ctrlKey || event.metaKey) {
    const tool = { z: "undo", y: "redo" }[key];
    if (tool && !target.matches("input, textarea") && !$("tools").hidden) { event.preventDefault(); $(tool).click(); }
    return;
  }
  if (event.altKey || !mine() || page.busy || page.lost) return;
  const elsewhere = target.closest("#tools, a, summary, textarea, #what, #again");
  if (key === "Enter") {
    if (elsewhere) return;
    event.preventDefault(); // each decision is one press
    if (!event.repeat) decide(false);
  } else if (key.length === 1 && !event.repeat && !elsewhere && !target.matches("input, select")) {
    if (current()?.press(key.toLowerCase())) event.preventDefault();
  }
};

// -- tools ---------------------------------------------------------------------------------------------

const number = (id) => Number.parseInt($(id).value, 10);

function wrong(text) { [$("wrong").textContent, $("wrong").hidden] = [text, !text]; }

for (const id of ["undo", "redo", "again"]) $(id).onclick = () => moved({ do: id });
$("skip").onclick = () => moved({ do: "skip" });
$("stop").onclick = () => send({ do: "delegate", n: 0 });
$("delegate").onclick = () => {
  const many = number("many");
  wrong(many >= 0 ? "" : "Enter a whole number of decisions.");
  if (many >= 0) moved({ do: "delegate", n: many });
};
$("restart").onclick = () => { $("sure").hidden = false; $("yes").focus(); };
$("no").onclick = () => { $("sure").hidden = true; };
$("yes").onclick = () => {
  const text = $("seed").value.trim(), seed = Number(text);
  const fits = !$("seed").validity.badInput && (!text || (Number.isInteger(seed) && seed >= 0 && seed < 2 ** 31));
  wrong(fits ? "" : "Enter a whole number of at least 0 as the seed, or none for a random one.");
  if (!fits) return;
  $("sure").hidden = true;
  moved({ do: "restart", n: text ? seed : null });
};
$("jump").oninput = () => { $("turn").textContent = `${Math.min(number("jump") + 1, page.state.length)} of ${page.state.length}`; };
$("jump").onchange = () => moved({ do: "jump", n: number("jump") });
$("of").onchange = redraw;
for (const id of ["horizon", "by", "hold"]) $(id).onchange = () => {
  const by = $("by").value, length = Number($("horizon").value);
  const hold = $("hold").value.trim() ? Number($("hold").value) : null;
  const holds = !$("hold").validity.badInput && (hold === null || (Number.isInteger(hold) && hold >= 1 && hold <= 100));
  const fits = length > 0 && (by === "time" || (Number.isInteger(length) && length <= 100));
  const whole = "Enter a whole number of decisions from 1 to 100";
  wrong(!fits ? (by === "time" ? "Enter a number above 0." : `${whole}.`) : holds ? "" : `${whole}, or nothing for all of them.`);
  if (fits && holds) send({ do: "horizon", by, n: length, hold });
};
$("seats").onclick = ({ target }) => { if (target.dataset.seat !== undefined) send({ do: "claim", seat: target.dataset.seat }); };

setInterval(() => { if (page.state?.left !== null && page.state && secondsLeft() !== null) drawClock(); }, 250);
