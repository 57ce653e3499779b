// What the theme lacks: a button that copies a block, and a search that also works from a folder (file://), where
// browsers refuse the worker and the request that the theme's own search needs.
document.querySelectorAll("pre").forEach(function (block) {
  const text = block.innerText;
  const button = document.createElement("button");
  button.type = "button";
  button.className = "copy";
  button.textContent = "copy";
  button.addEventListener("click", function () {
    const area = document.createElement("textarea");  // navigator.clipboard is not there without https
    area.value = text;
    document.body.append(area);
    area.select();
    button.textContent = document.execCommand("copy") ? "copied" : "select it";
    area.remove();
    setTimeout(function () { button.textContent = "copy"; }, 1500);
  });
  block.append(button);
});

(function () {
  const place = document.getElementById("mkdocs-search-results");
  const asked = new URLSearchParams(location.search).get("q");
  if (location.protocol !== "file:" || !place) return;
  const line = document.getElementById("mkdocs-search-query");
  const show = function () {
    const words = line.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = window.searchIndex.docs.map(function (part) {
      const title = part.title.toLowerCase(), body = part.text.toLowerCase();
      const each = words.map(function (word) { return 10 * title.includes(word) + 100 * (title === word) + body.split(word).length - 1; });
      return { part: part, score: Math.min.apply(null, each) > 0 ? each.reduce((a, b) => a + b, 0) : 0, body: body };
    }).filter(function (one) { return words.length && one.score > 0; });
    found.sort(function (a, b) { return b.score - a.score; });
    place.replaceChildren();
    found.slice(0, 30).forEach(function (one) {
      const head = document.createElement("h3"), link = document.createElement("a"), text = document.createElement("p");
      const at = Math.max(0, one.body.indexOf(words[0]) - 80);
      link.href = base_url + "/" + one.part.location;
      link.textContent = one.part.title;
      text.textContent = one.part.text.slice(at, at + 200);
      head.append(link);
      const article = document.createElement("article");
      article.append(head, text);
      place.append(article);
    });
    if (!found.length) place.textContent = "nothing found";
  };
  const index = document.createElement("script");
  index.src = base_url + "/search/search_index.js";
  index.onload = function () {
    if (asked && line) line.value = asked;
    line.addEventListener("input", show);
    line.form.addEventListener("submit", function (event) { event.preventDefault(); show(); });
    show();
  };
  document.body.append(index);
})();
