/** Topics and who listens to them. */
export class Emitter {
  #handlers = new Map();

  /** Call `handler` on each emit of `topic`. */
  on(topic, handler) {
    if (!this.#handlers.has(topic)) this.#handlers.set(topic, []);
    this.#handlers.get(topic).push(handler);
  }

  emit(topic, value) {
    for (const handler of this.#handlers.get(topic) ?? []) handler(value);
  }
}
