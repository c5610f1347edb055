/* Ask for the newest state only: a request waits until edits pause, and no answer is shown after
   that of a newer request. `ask(state)` returns a promise; `shown(answer, state)`,
   `failed(error, state)` and `busy(on)` are called for the newest request alone. */
export function latest({ask, shown, failed, busy = (_) => {}, delay = 120}) {
  let [number, timer] = [0, null];

  function stop() {
    number += 1;
    clearTimeout(timer);
    busy(false);
  }

  function request(state, wait = delay) {
    stop();
    const own = number;
    busy(true);
    timer = setTimeout(async () => {
      let [answer, error] = [null, null];
      try {
        answer = await ask(state);
      } catch (fault) {
        error = fault;
      }
      if (own !== number) return;
      busy(false);
      if (error) failed(error, state);
      else shown(answer, state);
    }, wait);
  }

  return {request, stop};
}
