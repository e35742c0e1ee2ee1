"""Configure Sphinx; tools/package runs it for the documentation."""
import pathlib
import re
import sys

from pygments.lexers.special import TextLexer

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / 'src'))

import pharos  # noqa: E402

project = 'pharos'
author = 'PhaROS developers'
release = version = pharos.__version__

# The source is the whole clone: a page links to README.md as it does where it is read there.
root_doc = 'doc/index'
include_patterns = [
    '*.md',
    'CHANGELOG.rst',
    'SECURITY.md',
    'doc/**.md',
    'benchmark/*.md',
    'examples/README.md',
]
exclude_patterns = ['build', '**/.*']
extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'sphinx.ext.graphviz',
]
myst_heading_anchors = 3
graphviz_output_format = 'svg'

autodoc_member_order = 'bysource'
autodoc_default_options = {'members': True}
autodoc_typehints_format = 'short'
python_use_unqualified_type_names = True
add_module_names = False
maximum_signature_line_length = 90  # Sphinx 7.1 and later

nitpicky = True
nitpick_ignore_regex = [
    # types of others, type variables, and what is internal
    ('py:(class|exc)', r'(genpy|rospy|rosgraph|threading|os|subprocess|types|_pytest)\..*'),
    (
        'py:class',
        r'(pharos\.channels\.Channel|.*\.(Snapshot|LaunchFile|Entry)|.*Run|Block|Edge|Message|(.*\.)?N)',
    ),
    # attributes that a docstring lists have no place of their own, nor has an inherited stop()
    ('py:(attr|data)', r'.*'),
    ('py:meth', r'(stop|Node\.serve)'),
]

html_theme = 'furo'
html_title = f'pharos {release}'
html_copy_source = False
html_show_copyright = False


def draw_flowcharts(app, name, source):
    """Have graphviz draw what GitHub draws by mermaid: Debian has no Sphinx extension for it."""
    source[0] = re.sub(
        r'^```mermaid\nflowchart TD\n(.*?)^```$', _by_graphviz, source[0], flags=re.M | re.S
    )


def _by_graphviz(flowchart):
    label = re.compile(r'(\w+)\["(.*?)"\]')
    # names in quotes: a box may be called node, which dot reserves
    nodes = '\n'.join(f'"{name}" [label=<{text}>]' for name, text in label.findall(flowchart[1]))
    edges = re.findall(r'(\w+) --> (\w+)', label.sub(r'\1', flowchart[1]))
    arrows = [f'"{start}" -> "{end}"' for start, end in edges]
    style = 'node [shape=box, fontname="sans-serif", fontsize=10, margin="0.2,0.1"]'
    dot = '\n'.join([style, nodes, *arrows])
    return f'```{{graphviz}}\ndigraph {{\n{dot}\n}}\n```'


def take_fields_apart(app, what, name, thing, options, lines):
    """Make of ``:raises A, B: why``, and of ``:param a, b: what``, a field for each of them; and have
    the underscore at the end of a name stay one, which is that of a link otherwise."""
    fields = re.sub(
        r'^:(raises|param) (\w+(?:, \w+)+):(.*(?:\n[ \t]+.*)*)',
        _apart,
        '\n'.join(lines),
        flags=re.M,
    )
    lines[:] = re.sub(r'^(:\w+ \w+)_:', r'\1\\_:', fields, flags=re.M).split('\n')


def _apart(field):
    return '\n'.join(f':{field[1]} {name}:{field[3]}' for name in field[2].split(', '))


def let_folders_be(app, name, source):
    """Make text of links to folders, which are for who reads the clone: a folder has no page."""
    page = ROOT / name

    def text_of(link):
        return link[1] if (page.parent / link[2]).is_dir() else link[0]

    source[0] = re.sub(r'(?<!!)\[([^][]+)\]\(([^)\s]+)\)', text_of, source[0])


def setup(app):
    """Set up this configuration; Sphinx calls it first."""
    app.connect('source-read', draw_flowcharts)
    app.connect('source-read', let_folders_be)
    app.connect('autodoc-process-docstring', take_fields_apart)
    for kind in 'debugger', 'ipython':  # of what is typed in the tutorial
        app.add_lexer(kind, TextLexer)
