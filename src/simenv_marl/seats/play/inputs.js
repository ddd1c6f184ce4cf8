// The answers to a decision: cards that are chosen, or fields that are filled in.

import { $, make, show } from "./charts.js";

const RULE_KEY = "r"; // at each decision, because people press what they have learned

// A key for each text: the number with which it begins, else one of its letters.
function keysFor(texts) {
  const keys = texts.map((text) => /^(\d)(?!\S*\d)/.exec(text)?.[1] ?? "");
  const used = new Set([RULE_KEY]);
  keys.forEach((key, i) => { if (used.has(key)) keys[i] = ""; used.add(key); });
  texts.forEach((text, i) => {
    if (keys[i]) return;
    const letters = [...text.toLowerCase().replace(/[^a-z]/g, ""), ..."abcdefghijklmnopqrstuvwxyz"];
    keys[i] = letters.find((letter) => !used.has(letter)) ?? "";
    used.add(keys[i]);
  });
  return keys;
}

const isNumber = ({ type }) => type === "integer" || type === "number";

// Put a value at a path into the JSON of an action: texts are keys, numbers are places in a list.
function put(whole, [key, ...path], value) {
  if (key === undefined) return value;
  whole ??= typeof key === "number" ? [] : {};
  whole[key] = put(whole[key], path, value);
  return whole;
}

export const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);

export class Answers {
  // changed: called when a person has touched something; active: whether this page decides.
  constructor(form, last, active, changed) {
    this.form = form;
    this.chosen = undefined; // the action of a card; null is the rule
    this.touched = false;
    this.active = active;
    this.changed = changed;
    this.cards = new Map();
    this.fields = (form.fields ?? []).map((field, i) => this.field(field, i));
    $("inputs").replaceChildren(...this.fields.map((field) => field.element));
    $("answers").replaceChildren();
    $("candidates").replaceChildren();
    const keys = keysFor((form.cards ?? []).map((card) => card.text));
    (form.cards ?? []).forEach((card, i) => this.card(card.action, card.text, keys[i], $("answers")));
    this.card(null, "By the rule", RULE_KEY, form.cards ? $("answers") : $("candidates"));
    if (last !== null) this.fill(last);
  }

  touch() {
    this.touched = true;
    this.changed();
  }

  // -- cards ---------------------------------------------------------------------------------------

  card(action, text, key, place) {
    const name = make("span", { className: "name" }, text), chart = make("span", { className: "chart" });
    const head = make("span", { className: "head" }, ...(key && this.active ? [make("kbd", {}, key)] : []), name);
    const card = make("button", { className: "card", type: "button", disabled: !this.active }, head, chart);
    card.setAttribute("role", "radio");
    card.setAttribute("aria-checked", "false");
    card.onclick = () => this.choose(action);
    this.cards.set(JSON.stringify(action), { card, name, chart, key, action });
    place.append(card);
    return this.cards.get(JSON.stringify(action));
  }

  choose(action) {
    if (!this.active) return;
    this.chosen = action;
    if (this.form.fields && action !== null) this.fill(action);
    this.mark();
    this.touch();
  }

  mark() {
    for (const { card, action } of this.cards.values())
      card.setAttribute("aria-checked", String(this.chosen !== undefined && same(action, this.chosen)));
  }

  press(key) {
    const found = [...this.cards.values()].find((card) => card.key === key);
    if (found) this.choose(found.action);
    return Boolean(found);
  }

  // -- fields --------------------------------------------------------------------------------------

  field(field, i) {
    const wrong = make("p", { className: "wrong", id: `wrong${i}`, hidden: true });
    wrong.setAttribute("role", "alert");
    const made = field.options ? this.choice(field, i) : isNumber(field) ? this.number(field) : this.text(field);
    const element = make("div", { className: "field" }, made.element, wrong);
    element.oninput = () => {
      this.chosen = undefined;
      wrong.hidden = true;
      this.mark();
      this.touch();
    };
    return { ...made, element, wrong, field };
  }

  number({ name, type, minimum: low, maximum: high }) {
    const limits = { ...(low === undefined ? {} : { min: low }), ...(high === undefined ? {} : { max: high }) };
    const step = type === "integer" ? 1 : "any", disabled = !this.active;
    const input = make("input", { type: "number", step, disabled, ...limits });
    const parts = [make("label", {}, name ? make("span", {}, name) : "Answer", " ", input)];
    let slider = null;
    if (high - low < 1e12) {
      slider = make("input", { type: "range", step, disabled, ...limits, ariaLabel: `${name || "Answer"}, slider` });
      slider.oninput = () => { input.value = +Number(slider.value).toPrecision(4); };
      input.addEventListener("input", () => { slider.value = input.value; });
      parts.push(make("span", { className: "range" }, show(low), slider, show(high)));
      slider.classList.add("empty");
      input.addEventListener("input", () => slider.classList.toggle("empty", input.value === ""));
      slider.addEventListener("input", () => slider.classList.remove("empty"));
    }
    const get = () => (input.value === "" ? (input.validity.badInput ? "?" : "") : Number(input.value));
    const set = (value) => {
      input.value = typeof value === "number" ? +value.toPrecision(7) : "";
      if (slider) { slider.value = input.value; slider.classList.toggle("empty", input.value === ""); }
    };
    return { element: make("div", {}, ...parts), get, set, input };
  }

  choice({ name, options }, i) {
    const radios = options.map(({ action }) =>
      make("input", { type: "radio", name: `field${i}`, value: action, disabled: !this.active }));
    const labels = options.map(({ text }, j) => make("label", { className: "pick" }, radios[j], ` ${text}`));
    const element = make("fieldset", {}, make("legend", {}, name), ...labels);
    const get = () => { const radio = radios.find((one) => one.checked); return radio ? Number(radio.value) : ""; };
    const set = (value) => radios.forEach((radio) => { radio.checked = Number(radio.value) === value; });
    return { element, get, set, input: radios[0] };
  }

  text({ name, maxLength, json }) {
    const input = make("textarea", { rows: 3, disabled: !this.active, ...(maxLength ? { maxLength } : {}) });
    const label = json ? `${name || "The answer"}, as JSON: ${json}` : name || "Your text";
    const get = () => (json ? (input.value.trim() ? JSON.parse(input.value) : "") : input.value);
    const set = (value) => { input.value = json ? JSON.stringify(value) : value; };
    return { element: make("label", {}, label, input), get, set, input };
  }

  // Fill in the fields from the JSON of an action.
  fill(action) {
    for (const { field, set } of this.fields) {
      const value = field.path.reduce((part, key) => part?.[key], action);
      if (value !== undefined) set(value);
    }
  }

  get isEmpty() {
    return this.fields.every(({ get }) => { try { return get() === ""; } catch { return false; } });
  }

  // The message of the decision; undefined if something is missing, which stands at its field then.
  message() {
    if (this.chosen !== undefined)
      return this.chosen === null ? { do: "rule" } : { do: "act", action: this.chosen };
    if (this.form.cards) return undefined;
    let fine = true, action;
    this.fields.forEach(({ get, field }, i) => {
      let value = "", problem = "";
      try { value = get(); } catch { problem = "This is not JSON."; }
      if (field.options && value === "") problem = "Choose one of these.";
      if (isNumber(field) && (typeof value !== "number" || value < field.minimum || value > field.maximum
        || (field.type === "integer" && !Number.isInteger(value)))) problem = `Enter ${field.hint}.`;
      if (field.json && value === "" && !problem) problem = "Enter the answer.";
      this.complain(i, problem);
      fine &&= !problem;
      action = put(action, field.path, value);
    });
    return fine ? { do: "act", action } : undefined;
  }

  complain(i, text) {
    const { wrong, input } = this.fields[i];
    [wrong.textContent, wrong.hidden] = [text, !text];
    input.setAttribute("aria-invalid", String(Boolean(text)));
    input.setAttribute("aria-describedby", wrong.id);
  }
}
