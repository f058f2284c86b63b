"""Sphinx configuration: Markdown pages, docstrings, equations as MathML. Nothing is fetched from any network."""

import dataclasses
import importlib
import re
import sys
from importlib.metadata import version as distribution_version
from pathlib import Path

import jaxtyping  # noqa: F401 - before saltus, so that signatures show shapes
from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

sys.path.insert(0, str(Path(__file__).parent))
import house

project = "Saltus"
author = "The Saltus authors"
copyright = "The Saltus authors, Apache-2.0"
version = release = distribution_version("saltus")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist", "attrs_block"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
highlight_language = "none"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_use_type_comments = False
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
math_eqref_format = "equation {number}"
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"Saltus {release}"
html_static_path = ["_static"]
html_css_files = ["saltus.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {
    "light_css_variables": {
        "color-brand-primary": "#1f4f86",
        "color-brand-content": "#1f4f86",
        "color-brand-visited": "#1f4f86",
    },
    "dark_css_variables": {
        "color-brand-primary": "#8fb8e6",
        "color-brand-content": "#8fb8e6",
        "color-brand-visited": "#8fb8e6",
    },
}


def mathml(latex: str, block: bool) -> str:
    """Turn an equation into MathML, which browsers draw themselves."""
    return latex2mathml.tex2mathml(latex, as_block=block)


def visit_math(self, node):
    """Write an equation in a line of text."""
    self.body.append(mathml(node.astext(), block=False))
    raise nodes.SkipNode


def visit_displaymath(self, node):
    """Write an equation on its own line, with its number and an anchor if it is labelled."""
    anchor = f' id="{node["ids"][0]}"' if node.get("ids") else ""
    self.body.append(f'<div class="equation"{anchor}><div class="formula">{mathml(node.astext(), block=True)}</div>')
    if node.get("number"):
        self.body.append(f'<span class="eqno">({node["number"]})')
        self.add_permalink_ref(node, "Link to this equation")
        self.body.append("</span>")
    self.body.append("</div>\n")
    raise nodes.SkipNode


class SettingsTable(SphinxDirective):
    """A table of a settings dataclass: key, default, meaning, from its fields and the Attributes of its docstring."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Build the table."""
        module, _, name = self.arguments[0].rpartition(".")
        kind = getattr(importlib.import_module(module), name)
        meaning = attributes(kind.__doc__)
        table = nodes.table(classes=["settings"])
        group = nodes.tgroup(cols=3)
        table += group
        for width in (22, 18, 60):
            group += nodes.colspec(colwidth=width)
        group += nodes.thead("", row([text(word) for word in ("key", "default", "meaning")]))
        body = nodes.tbody()
        group += body
        for field in dataclasses.fields(kind):
            said = meaning[field.name][0].upper() + meaning[field.name][1:]
            body += row([literal(field.name), literal(toml(field.default)), text(said)])
        return [table]


def attributes(doc: str) -> dict[str, str]:
    """Read the Attributes section of a docstring: name -> text."""
    section = doc.partition("Attributes:\n")[2]
    meaning = {}
    for names, said in re.findall(r"^        (\w+(?:, \w+)*): (.*(?:\n {12}.*)*)", section, re.MULTILINE):
        first, *others = names.split(", ")
        meaning[first] = re.sub(r"\s+", " ", said)
        meaning |= {name: f"see `{first}`." for name in others}
    return meaning


def toml(value: object) -> str:
    """Write a default as it stands in a configuration file."""
    if isinstance(value, tuple):
        return "[" + ", ".join(toml(v) for v in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def row(cells: list[nodes.Node]) -> nodes.row:
    """Make a row of a table."""
    made = nodes.row()
    for cell in cells:
        made += nodes.entry("", nodes.paragraph("", "", *cell))
    return made


def text(words: str) -> list[nodes.Node]:
    """Read a line in which `...` is literal."""
    parts = re.split(r"`([^`]*)`", words)
    return [nodes.literal(p, p) if k % 2 else nodes.Text(p) for k, p in enumerate(parts) if p]


def literal(word: str) -> list[nodes.Node]:
    """Make a literal."""
    return [nodes.literal(word, word)]


class NameTable(Directive):
    """The public names of the package's root, each with its home and the first sentence of its docstring."""

    def run(self) -> list[nodes.Node]:
        """Build the list."""
        import saltus

        listed = nodes.bullet_list()
        for name in saltus.__all__:
            value = getattr(saltus, name)
            first = (value.__doc__ or "").strip().splitlines()[0]
            home = saltus._EXPORTS[name]
            line = nodes.paragraph()
            line += [nodes.literal("", name), nodes.Text(f" ({home}): "), *text(first)]
            listed += nodes.list_item("", line)
        return [listed]


class House(Directive):
    """The drawing of the one-way house."""

    def run(self) -> list[nodes.Node]:
        """Put it on the page."""
        return [nodes.raw("", house.draw(), format="html")]


def as_markup(app, what, name, obj, options, lines):
    """Let docstrings be plain text: equations full of * and | are no markup, `code` is literal."""
    del app, what, name, obj, options
    for k, line in enumerate(lines):
        parts = re.split(r"(``?[^`]*``?)", line)
        for i, part in enumerate(parts):
            if part.startswith("`"):
                parts[i] = f"``{part.strip('`')}``"
            else:
                parts[i] = re.sub(r"([*|\\])|(?<=\w)(_)(?=[^\w]|$)", r"\\\g<0>", part)
        lines[k] = "".join(parts)


def as_signature(app, what, name, obj, options, signature, returned):
    """Give array types their short names: an expanded ArrayLike takes three lines."""
    del app, what, name, obj, options
    return tuple(None if part is None else shortened(part) for part in (signature, returned))


def shortened(signature: str) -> str:
    """Put aliases back in place of what Python expands them to."""
    signature = re.sub(r"~?\b(?:numpy|typing|collections|dataclasses|jaxtyping)(?:\.\w+)*\.(?=\w)", "", signature)
    like = r"_Buffer \| _SupportsArray\[dtype\[Any\]\] \| _NestedSequence\[_SupportsArray\[dtype\[Any\]\]\]"
    like += r" \| (?:\w+ \| )*_NestedSequence\[[\w| ]+\]"
    signature = re.sub(like, "ArrayLike", signature)
    return re.sub(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[(\w+)\]\]", r"NDArray[\1]", signature)


def skip_member(app, what, name, obj, skip, options):
    """Leave out what says nothing: fields of named tuples (their class lists them), inherited tuple methods."""
    del app, what, options
    if type(obj).__name__ == "_tuplegetter" or name in ("__new__", "__init__"):
        return True
    return skip


def setup(app: Sphinx) -> dict[str, object]:
    """Connect everything to Sphinx."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displaymath, None))
    app.add_directive("settings-table", SettingsTable)
    app.add_directive("house", House)
    app.add_directive("public-names", NameTable)
    app.connect("autodoc-process-docstring", as_markup, priority=300)
    app.connect("autodoc-process-signature", as_signature)
    app.connect("autodoc-skip-member", skip_member)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


html_math_renderer = "mathml"
