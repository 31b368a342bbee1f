// The order of search results: pages that teach come before lists of names and numbers.
const LISTS = ["api", "constants", "genindex", "how_we_know", "references", "way_of_a_sample"];

var Scorer = {
  score: (result) => {
    const [page, title, anchor, description, score] = result;
    return LISTS.includes(page) ? score - 100 : score;
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
