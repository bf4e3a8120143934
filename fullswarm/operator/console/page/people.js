/** The operators on this console: who is here, what they hold and drive; robots are offered to one of them, and accepted. */

import { byId, make, setFlag, setText } from "./dom.js";
import { short } from "./fleet.js";

/** @import { HandOverFrame, Offer, Person, PresenceFrame } from "./types.d.ts" */

const TICK_MS = 500;
const NAMED = 3; // robots on a button; its title has all

export class People {
  /**
   * @param {{store: import("./store.js").Store, selection: import("./selection.js").Selection,
   *   commands: import("./commands.js").Commands, hint: (words: string) => void}} parts
   *   store: what is now; hint: shows words above the map
   */
  constructor({ store, selection, commands, hint }) {
    this.store = store;
    this.selection = selection;
    this.commands = commands;
    this.hint = hint;
    this.button = byId("people");
    this.panel = byId("people-panel");
    this.button.addEventListener("click", () => this.open(this.panel.hidden));
    byId("people-close").addEventListener("click", () => this.open(false));
    this.panel.addEventListener("keydown", ({ key }) => key === "Escape" && this.open(false));
    for (const id of ["tabs", "time-more"]) byId(id).addEventListener("click", () => this.#hide());
    store.on("presence", (frame) => this.#present(frame));
    store.on("offers", ({ offers }) => this.#offered(offers));
    store.on("handover", (outcome) => this.#ended(outcome));
    store.on("leases", () => this.#list());
    store.on("hello", () => this.#list());
    selection.on("change", () => this.#list());
    byId("offer-yes").addEventListener("click", () => this.#answer("accept"));
    byId("offer-no").addEventListener("click", () => this.#answer(this.#offer?.mine ? "withdraw" : "decline"));
    setInterval(() => this.#tick(), TICK_MS);
  }

  #people = /** @type {PresenceFrame} */ ({ t: "presence", people: [], here: 0, more: 0 });
  #offers = /** @type {Offer[]} */ ([]);
  #received_ms = 0;
  #shown = "";

  /** The offer in the banner: one to this operator goes before those that they made. */
  get #offer() {
    return this.#offers.find(({ mine }) => !mine) ?? this.#offers[0];
  }

  /** @param {boolean} open */
  open(open) {
    if (open && !byId("time-panel").hidden) byId("time-close").click(); // it has the same place
    const fold = byId("bar-fold");
    if (fold.getAttribute("aria-expanded") === "true") fold.click(); // the menu would lie over the list
    this.panel.hidden = !open;
    setFlag(this.button, "aria-expanded", open);
    if (open) byId("people-close").focus();
    else (this.button.checkVisibility() ? this.button : fold).focus({ preventScroll: true });
  }

  #hide() {
    this.panel.hidden = true;
    setFlag(this.button, "aria-expanded", false);
  }

  /** @param {PresenceFrame} frame */
  #present(frame) {
    this.#people = frame;
    const words = `${frame.here} here`;
    this.button.removeAttribute("data-unknown");
    setText(this.button, words);
    setFlag(this.button, "aria-label", `${words}: operators on this console`);
    this.button.title = ["Operators on this console", ...frame.people.map(({ name }) => name)].join("\n");
    byId("bar-fold").dataset.people = String(frame.here);
    this.#list();
  }

  /** The robots that would be offered: the selected ones that this operator holds, else all of those. */
  #mine() {
    const mine = [...this.store.leases.values()].filter((lease) => lease.mine).map(({ robot }) => robot);
    const selected = mine.filter((robot) => this.selection.has(robot));
    return selected.length ? selected : mine;
  }

  #list() {
    const mine = this.store.hello?.read_only ? [] : this.#mine();
    const key = JSON.stringify([this.#people, mine, this.store.hello?.operator]);
    if (key === this.#shown) return;
    this.#shown = key;
    const focused = document.activeElement instanceof HTMLElement ? document.activeElement.dataset.testid : "";
    byId("people-list").replaceChildren(...this.#people.people.map((person) => this.#row(person, mine)));
    byId("people-more").hidden = this.#people.more === 0;
    setText(byId("people-more"), `and ${this.#people.more} more`);
    const alone = !this.#people.people.some((person) => this.#takes(person));
    setText(byId("people-help"), helpWords(alone, mine.length > 0));
    if (focused?.startsWith("offer-to-")) /** @type {HTMLElement | null} */ (document.querySelector(`[data-testid="${CSS.escape(focused)}"]`))?.focus();
  }

  /** @param {Person} person */
  #takes({ name, pages, role }) {
    return pages > 0 && role !== "observer" && name !== this.store.hello?.operator;
  }

  /**
   * @param {Person} person
   * @param {string[]} mine
   */
  #row(person, mine) {
    const me = person.name === this.store.hello?.operator;
    const offer = make("button", {
      type: "button", class: "small", testid: `offer-to-${person.name}`, text: `Offer ${short(mine, NAMED)}`,
      title: `Offer ${mine.join(", ")} to ${person.name}`, on: { click: () => this.#make(person.name, mine) },
    });
    return make(
      "li", { class: "person", testid: `person-${person.name}` },
      make("strong", { text: person.name, title: person.name }), me ? make("span", { class: "entry-mine", text: "you" }) : "",
      make("p", { class: "quiet", text: personWords(person) }),
      mine.length && this.#takes(person) ? offer : "",
    );
  }

  /**
   * @param {string} to
   * @param {string[]} offered
   */
  #make(to, offered) {
    this.#send({ op: "offer", to, robots: offered });
  }

  /** @param {"accept" | "decline" | "withdraw"} op */
  #answer(op) {
    if (this.#offer) this.#send({ op, id: this.#offer.id });
  }

  /** @param {{op: string, [field: string]: unknown}} fields */
  async #send(fields) {
    const reason = fields.op === "accept" || fields.op === "offer" ? this.commands.withheld : "";
    const answer = reason ? { ok: false, reason } : await this.commands.link.ask({ t: "handover", ...fields });
    if (!answer.ok) this.hint(`Not handed over: ${answer.reason}`);
  }

  /** @param {Offer[]} offers */
  #offered(offers) {
    this.#offers = offers;
    this.#received_ms = performance.now();
    const offer = this.#offer;
    byId("offer").hidden = !offer;
    if (!offer) return;
    setText(byId("offer-words"), offerWords(offer, offers.length - 1));
    byId("offer-words").title = `${offer.robots.join(", ")}`;
    byId("offer-yes").hidden = offer.mine;
    setText(byId("offer-no"), offer.mine ? "Withdraw" : "Decline");
    this.#tick();
  }

  #tick() {
    if (!this.#offer) return;
    const left_s = this.#offer.left_s - (performance.now() - this.#received_ms) / 1000;
    setText(byId("offer-left"), `${Math.max(0, Math.ceil(left_s))} s`);
  }

  /** @param {HandOverFrame} outcome */
  #ended({ words }) {
    this.hint(words[0].toUpperCase() + words.slice(1));
  }
}

/**
 * What an operator does here, in words.
 * @param {Person} person
 */
export function personWords({ role, pages, clock, holds, holding, drives }) {
  const more = holding - holds.length;
  return [
    pages ? `${role}, since ${clock}` : "elsewhere: a shell, a program or another console", pages > 1 ? `${pages} pages` : "",
    holding ? `holds ${short(holds)}${more > 0 ? ` and ${more} more` : ""}` : "", drives.length ? `drives ${short(drives)}` : "",
  ].filter(Boolean).join(" · ");
}

/**
 * @param {Offer} offer
 * @param {number} others
 */
export function offerWords({ from, to, robots: offered, runs, mine }, others) {
  const more = others > 0 ? ` ${others} more offer${others === 1 ? "" : "s"} wait.` : "";
  if (mine) return `${short(offered)} offered to ${to}.${more}`;
  return `${from} offers you ${short(offered)}${runs ? `, running ${runs}` : ""}.${more}`;
}

/**
 * @param {boolean} alone
 * @param {boolean} holding
 */
function helpWords(alone, holding) {
  if (alone) return "To hand robots over, another operator must have this console open.";
  if (!holding) return "To hand robots over, hold some: you hold what you request by name.";
  return "Offer hands over the selected robots that you hold, else all of them. The other has 30 s to accept; until then nothing changes.";
}
