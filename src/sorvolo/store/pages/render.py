"""Pages and drawings made from the templates beside: every value is escaped unless it was made by a template."""

import math
from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

_HOME = "sorvolo.store.pages"


def render(template: str, *, package: str = _HOME, **values: Any) -> Markup:
    """The template `templates/<template>` of a package filled with these values, as text that needs no more escaping."""
    return Markup(_environment(package).get_template(template).render(**values))


def cell(macro: str, *values: Any) -> Markup:
    """A cell of a table, by a macro of `templates/cells.html`."""
    return Markup(getattr(_environment(_HOME).get_template("cells.html").module, macro)(*values))


@cache
def _environment(package: str) -> Environment:
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader(_HOME)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["px"] = _px
    environment.filters["percent"] = _percent
    return environment


def _px(value: float) -> str:
    """A length in a drawing."""
    return f"{value:.1f}"


def _percent(share: float) -> str:
    """A width in a style; 0 for an unknown share."""
    return f"{100 * share if math.isfinite(share) else 0:.2f}%"
