"""Templates of report pages: each extends ``base.html`` of this package."""

from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

from lerobot_vtrefine.wording import plural


def render(package: str, template: str, **values: Any) -> str:
    """A template of a package as HTML text; a value that the template needs and does not get is an error."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package, "."), PackageLoader("lerobot_vtrefine.pages", ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["plural"] = plural
    return environment.get_template(template).render(**values)
