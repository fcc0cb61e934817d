(function () {
  var swipe = document.querySelector(".swipe");
  if (!swipe) { return; }
  var stack = swipe.querySelector(".stack"), slider = swipe.querySelector("input[type=range]"), zoom = 1, held = false;
  function show() { swipe.style.setProperty("--split", slider.value + "%"); }
  function follow(event) {
    var box = stack.getBoundingClientRect();
    slider.value = Math.max(0, Math.min(100, 100 * (event.clientX - box.left) / box.width));
    show();
  }
  slider.addEventListener("input", show);
  stack.addEventListener("pointerdown", function (event) {
    if (event.target.closest(".pin") || event.button !== 0) { return; }
    var box = stack.getBoundingClientRect(), line = box.left + box.width * slider.value / 100;
    if (zoom > 1 && Math.abs(event.clientX - line) > 40) { return; }
    held = true;
    stack.setPointerCapture(event.pointerId);
    follow(event);
  });
  stack.addEventListener("pointermove", function (event) { if (held) { follow(event); } });
  ["pointerup", "pointercancel"].forEach(function (name) {
    stack.addEventListener(name, function () { held = false; });
  });
  swipe.querySelectorAll("button").forEach(function (button) {
    button.addEventListener("click", function () {
      var view = stack.parentElement, wide = zoom;
      var x = (view.scrollLeft + view.clientWidth / 2) / zoom, y = (view.scrollTop + view.clientHeight / 2) / zoom;
      zoom = Math.max(1, Math.min(8, button.value === "closer" ? zoom * 2 : zoom / 2));
      if (zoom !== wide) {
        stack.style.width = 100 * zoom + "%";
        stack.style.touchAction = zoom > 1 ? "auto" : "pan-y";
        view.scrollLeft = x * zoom - view.clientWidth / 2;
        view.scrollTop = y * zoom - view.clientHeight / 2;
      }
    });
  });
  show();
})();
