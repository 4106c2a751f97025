/** Calls listeners by the name of an event. `Events` maps each name to the type of its value. */
export class Emitter {
    #listeners = new Map();
    /** Adds a listener. Returns a function that removes it. */
    on(name, listener) {
        const listeners = this.#listeners.get(name) ?? new Set();
        this.#listeners.set(name, listeners);
        listeners.add(listener);
        return () => listeners.delete(listener);
    }
    emit(name, value) {
        for (const listener of [...(this.#listeners.get(name) ?? [])]) {
            try {
                listener(value);
            }
            catch (error) {
                // A listener that fails must not disturb the stream. Its error is reported as if nobody had called it.
                setTimeout(() => {
                    throw error;
                });
            }
        }
    }
}
