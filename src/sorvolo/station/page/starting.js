// Where the page's script does not come, or is half an older one: say so and load it again.

addEventListener("error", ({ target }) => {
  if (document.body.dataset.screen || (target !== window && target.tagName !== "SCRIPT")) return;
  document.getElementById("main").replaceChildren(document.getElementById("not-whole").content.cloneNode(true));
  setTimeout(() => location.reload(), 5000);
}, true);
