"""package.xml names what is used, and nothing else."""
import ast
import pathlib
import re
import sysconfig
import xml.etree.ElementTree
from importlib.util import find_spec

ROOT = pathlib.Path(__file__).resolve().parent.parent
STANDARD_LIBRARY = sysconfig.get_path('stdlib')

#: the module of each package that is called otherwise
KEYS = {
    'IPython': 'ipython3',
    'PIL': 'python3-pil',
    'catkin_pkg': 'catkin',  # which is made of it
    'matplotlib': 'python3-matplotlib',
    'hypothesis': 'python3-hypothesis',
    'ipykernel': 'jupyter-notebook',  # rosdep has no name for this alone, nor for the next
    'jupyter_client': 'jupyter-notebook',
    'numpy': 'python3-numpy',
    'pexpect': 'python3-pexpect',
    'psutil': 'python3-psutil',
    'pytest': 'python3-pytest',
    'rich': 'python3-rich',
    'rospkg': 'python3-rospkg',
    'tkinter': 'python3-tk',
    'traitlets': 'ipython3',  # which is made of it
    'yaml': 'python3-yaml',
}
#: what each tool has no use for: the demonstration draws no pictures of messages, and no tables
UNNEEDED = {'demo': {'python3-matplotlib', 'python3-numpy', 'python3-rich'}, 'test': set()}
#: the package of each program that is run
PROGRAMS = {'dot': 'graphviz', 'sfdp': 'graphviz'}
#: what is part of this package: its modules, those of its tests, and types that it defines itself
OWN = {
    'pharos',
    'pharos_turtle',
    'nested',
    'turtlesim',
    *(path.stem for path in (ROOT / 'test').rglob('*.py')),
    *(path.name for path in (ROOT / 'test' / 'programs' / 'workspace').iterdir()),
    'beside_it',  # is written by a test
}


def sources(*folders):
    """The Python files there, scripts without a suffix among them."""
    files = [
        path
        for folder in folders
        for path in (ROOT / folder).rglob('*')
        if path.suffix in ('', '.py')
    ]
    return [path for path in files if path.is_file() and is_python(path)]


def is_python(path):
    return path.suffix == '.py' or 'python' in path.read_text().partition('\n')[0]


def imports(source):
    """The top-level modules that it imports, in its functions and in the programs that it has in
    strings, too, but for what only a type checker imports; and those without which it skips its
    tests."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.dump(node.test) == ast.dump(
            ast.Name('TYPE_CHECKING', ast.Load())
        ):
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition('.')[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module.partition('.')[0]
        elif isinstance(node, ast.Call) and getattr(node.func, 'attr', None) == 'importorskip':
            yield node.args[0].value.partition('.')[0]
        elif isinstance(node, ast.Constant) and re.match(r'\s*(import|from) \w', str(node.value)):
            yield from program_imports(node.value)


def program_imports(text):
    try:
        return list(imports(text))
    except SyntaxError:  # a sentence that begins so, or half a program
        return []


def types(source):
    """The packages of the message and service types that it names."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and re.fullmatch(r'[a-z]\w*/[A-Z]\w*', str(node.value)):
            yield node.value.partition('/')[0]


def libraries(source):
    """The packages of the libraries that it binds to a node, by ros_import."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and getattr(node.func, 'attr', None) == 'ros_import':
            yield node.args[0].value.partition('.')[0]


def programs(source):
    """The packages of the programs that it names first in a list, as subprocess takes them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.List) and node.elts and isinstance(node.elts[0], ast.Constant):
            if node.elts[0].value in PROGRAMS:
                yield PROGRAMS[node.elts[0].value]


def is_standard(module):
    if module in KEYS:  # tkinter is a package of its own in Debian
        return False
    spec = find_spec(module)
    if spec is None or spec.origin in (None, 'built-in', 'frozen'):
        return spec is not None
    return spec.origin.startswith(STANDARD_LIBRARY) and '-packages' not in spec.origin


def keys(modules):
    return {KEYS.get(module, module) for module in set(modules) - OWN if not is_standard(module)}


def declared(*tags):
    manifest = xml.etree.ElementTree.parse(ROOT / 'package.xml').getroot()
    return {depend.text for tag in tags for depend in manifest.findall(tag)}


def test_what_is_used_at_run_time_is_declared_and_nothing_else():
    # whoever uses pharos.testing has pytest, which runs it, and mypy its plugin
    run_by_others = 'testing.py', 'mypy_plugin.py'
    paths = [path for path in sources('src', 'scripts') if path.name not in run_by_others]
    texts = [path.read_text() for path in paths]
    used = keys(
        name
        for text in texts
        for found in (imports, types, libraries, programs)
        for name in found(text)
    )
    assert used == declared('depend', 'exec_depend')


def test_what_the_tests_import_and_the_examples_use_is_declared():
    # the packages of users, by which they test, have manifests of their own
    paths = [path for path in sources('test') if ROOT / 'test' / 'packages' not in path.parents]
    used = keys(name for path in paths for name in imports(path.read_text()))
    texts = [path.read_text() for path in sources('examples')]
    used |= keys(
        name for text in texts for found in (imports, types, libraries) for name in found(text)
    )
    assert used - declared('depend', 'exec_depend', 'test_depend') == set()


def test_nothing_is_declared_twice():
    assert declared('exec_depend') & declared('test_depend') == set()


def test_the_tools_install_what_debian_has_under_that_name():
    """The rest comes along with rospy and roslaunch."""
    manifest = xml.etree.ElementTree.parse(ROOT / 'package.xml')
    needed = {element.text for element in manifest.iter('exec_depend')}
    for tool in 'demo', 'test':
        text = (ROOT / 'tools' / tool).read_text()
        missing = {
            name for name in needed if name.startswith('python3-') and f' {name} ' not in text
        }
        assert missing - {'python3-rospkg', 'python3-tk', 'python3-yaml'} == UNNEEDED[tool], tool
