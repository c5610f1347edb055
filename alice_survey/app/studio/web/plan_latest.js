/* Ask for the newest state only: a request waits until edits pause, stops the one on its way, and
   no answer is shown after that of a newer request. */

/* `ask(state, signal)` returns a promise; `shown(answer, state)`, `failed(error, state)` and
   `busy(on)` are called for the newest request alone. */
export function latest({ask, shown, failed, busy = (_) => {}, delay = 120}) {
  let [number, timer, onItsWay] = [0, null, null];

  function stop() {
    number += 1;
    clearTimeout(timer);
    if (onItsWay) onItsWay.abort();
    onItsWay = null;
    busy(false);
  }

  function request(state, wait = delay) {
    stop();
    const own = number;
    busy(true);
    timer = setTimeout(async () => {
      onItsWay = new AbortController();
      let [answer, error] = [null, null];
      try {
        answer = await ask(state, onItsWay.signal);
      } catch (fault) {
        error = fault;
      }
      if (own !== number) return;
      onItsWay = null;
      busy(false);
      if (error) failed(error, state);
      else shown(answer, state);
    }, wait);
  }

  return {request, stop};
}
