/* What a page has saved itself, among the changes that the server reports to all pages.

   A report may come before the answer to the request that it is of, and after the answer to the
   next one. */

export function startOwnSaves() {
  const tokens = [];
  let saving = /** @type {Promise<any>} */ (Promise.resolve());
  return {
    /* Send a change; the answer has the token of the file as it is then. */
    save(request) {
      const answered = request.then((answer) => {
        tokens.push(answer.token);
        return answer;
      });
      saving = Promise.allSettled([saving, answered]);
      return answered;
    },
    /* Whether a report of this token is of such a change, each of which has one report. */
    async isOwn(token) {
      await saving;
      const at = tokens.indexOf(token);
      if (at >= 0) tokens.splice(at, 1);
      return at >= 0;
    },
  };
}
