"""The looks of the page of changes beyond those of the report, and the little script that moves its swipe."""

STYLE = """
:root{--appeared:#0b7a53;--disappeared:#c2362b;--replaced:#7a3fc4;--moving:#b86e00}
@media (prefers-color-scheme:dark){:root{--appeared:#35b98a;--disappeared:#ef6a5e;--replaced:#b98af5;--moving:#f0a835}}
main{max-width:1160px}
.swipe{--split:50%}
.scroll{overflow:auto;max-height:86vh;border-radius:12px;border:1px solid var(--rule);background:#ececec}
.stack{position:relative;width:100%;touch-action:pan-y;overflow:hidden}
.stack img,.stack svg{display:block;width:100%;height:auto;user-select:none;-webkit-user-drag:none}
.stack .over-picture{position:absolute;inset:0;height:100%}
.stack .after{clip-path:inset(0 0 0 var(--split))}
.stack svg{pointer-events:none}
.stack .edge{position:absolute;top:0;bottom:0;left:var(--split);width:3px;margin-left:-1.5px;background:#fff;
box-shadow:0 0 4px #0008;pointer-events:none}
.stack .edge::after{content:"\\2194";position:absolute;top:50%;left:50%;width:34px;height:34px;margin:-17px;
border-radius:50%;background:#fff;color:#1d2624;text-align:center;line-height:33px;font-size:20px;
box-shadow:0 0 5px #0007}
.stack .date{position:absolute;top:10px;padding:2px 10px;border-radius:9px;background:#000a;color:#fff;font-size:.82rem;
pointer-events:none;max-width:46%}
.stack .date.old{left:10px}.stack .date.new{right:10px}
.slider{display:flex;gap:12px;align-items:center;margin-top:10px;font-size:.9rem;color:var(--soft)}
.slider input{flex:1;accent-color:var(--vision);height:28px;margin:0}
.slider button{font:inherit;min-width:34px;height:32px;border:1px solid var(--rule);border-radius:8px;
background:var(--paper);color:var(--ink);cursor:pointer}
.stack polygon{fill:none;stroke-width:2.2;vector-effect:non-scaling-stroke}
.stack polygon.halo{stroke:#fff;stroke-width:4.6;opacity:.75}
polygon.appeared{stroke:#0b7a53}polygon.disappeared{stroke:#d5301f}polygon.replaced{stroke:#7a3fc4}
polygon.moving{stroke:#e08600;stroke-dasharray:5 3}
.pin{position:absolute;min-width:22px;height:22px;padding:0 5px;border-radius:11px;
color:#fff;font-size:12px;line-height:20px;font-weight:650;text-align:center;text-decoration:none;
border:1px solid #fff;box-shadow:0 1px 3px #0008}
.pin:hover,.pin:focus{z-index:3;outline:3px solid #fff}
.many .pin{min-width:17px;height:15px;line-height:13px;font-size:10px;padding:0 3px;border-radius:8px}
.pin.appeared,.kind.appeared{background:#0b7a53}.pin.disappeared,.kind.disappeared{background:#d5301f}
.pin.replaced,.kind.replaced{background:#7a3fc4}.pin.moving,.kind.moving{background:#b86e00}
.pin.is-rejected{opacity:.55;text-decoration:line-through}
.kind{display:inline-block;color:#fff;border-radius:9px;padding:0 9px;font-size:.82rem;line-height:1.6;font-weight:600}
.legend{display:flex;flex-wrap:wrap;gap:8px 18px;margin:0 0 12px;font-size:.92rem}
.legend label{display:flex;gap:7px;align-items:center;cursor:pointer}
main:has(#show-appeared:not(:checked)) [data-kind=appeared],
main:has(#show-disappeared:not(:checked)) [data-kind=disappeared],
main:has(#show-replaced:not(:checked)) [data-kind=replaced],
main:has(#show-moving:not(:checked)) [data-kind=moving],
main:has(#show-rejected:not(:checked)) .is-rejected{display:none}
.change{display:grid;grid-template-columns:minmax(250px,430px) 1fr;gap:18px;padding:18px 0;
border-bottom:1px solid var(--rule);scroll-margin-top:14px}
.change:last-child{border-bottom:0}
.change:target{background:linear-gradient(90deg,var(--warn),transparent);border-radius:8px}
.change.is-rejected h3,.change.is-rejected .crops{opacity:.5}
.change h3{margin:0 0 .5em;font-size:1.02rem;display:flex;gap:10px;align-items:center;flex-wrap:wrap}
.change h3 a{color:inherit;text-decoration:none}
.crops{display:grid;grid-template-columns:1fr 1fr;gap:6px}
.crops figure{margin:0;position:relative}
.crops img{display:block;width:100%;aspect-ratio:1;object-fit:contain;background:#ececec;border-radius:8px}
.crops svg{position:absolute;top:0;left:0;width:100%;aspect-ratio:1;height:auto}
.crops polygon{fill:none;stroke-width:1.8;vector-effect:non-scaling-stroke}
.crops polygon.halo{stroke:#fff;stroke-width:3.6;opacity:.6}
.crops figcaption{margin:2px 0 0;font-size:.78rem}
.crops .gone{aspect-ratio:1;display:grid;place-items:center;border-radius:8px;background:var(--rule);color:var(--soft);
font-size:.8rem}
.facts{display:grid;grid-template-columns:repeat(auto-fill,minmax(150px,1fr));gap:6px 18px;margin:0;font-size:.92rem}
.facts dt{color:var(--soft);font-size:.78rem}
.facts dd{margin:0;font-variant-numeric:tabular-nums;overflow-wrap:anywhere}
.verdict{font-size:.8rem;font-weight:600;border:1.5px solid;border-radius:9px;padding:0 8px;line-height:1.5}
.verdict.confirmed{color:var(--appeared)}.verdict.rejected{color:var(--disappeared)}
.wide.long{max-height:70vh;overflow:auto}.long th{position:sticky;top:0;background:var(--paper)}
.overview a{color:inherit}
.over b,h1{overflow-wrap:anywhere}
.overview td,.overview th{white-space:nowrap}
@media (max-width:680px){.change{grid-template-columns:1fr}section{padding:16px}}
@media print{.slider,.edge{display:none}.scroll,.wide.long{overflow:visible;max-height:none}.change{break-inside:avoid}}
"""

SCRIPT = """
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
"""
