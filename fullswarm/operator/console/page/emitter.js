/**
 * Topics and who listens to them.
 * @template {object} Topics topic → what its handlers are called with
 */
export class Emitter {
  #handlers = /** @type {Map<keyof Topics, ((value: unknown) => void)[]>} */ (new Map());

  /**
   * Call `handler` on each emit of `topic`.
   * @template {keyof Topics} T
   * @param {T} topic
   * @param {(value: Topics[T]) => void} handler
   */
  on(topic, handler) {
    const handlers = this.#handlers.get(topic) ?? [];
    this.#handlers.set(topic, [...handlers, /** @type {(value: unknown) => void} */ (handler)]);
  }

  /**
   * @template {keyof Topics} T
   * @param {T} topic
   * @param {Topics[T]} [value]
   */
  emit(topic, value) {
    for (const handler of this.#handlers.get(topic) ?? []) handler(value);
  }
}
