"""Catkin's spaces as the tests need them: packages with messages and code in devel, install and
Debian's space, built without catkin."""
import pathlib
import shutil
import sys

import genmsg.msg_loader
from genpy.generator import msg_generator, srv_generator

SOURCES = pathlib.Path(__file__).parent / 'programs' / 'workspace'
#: what catkin writes into a devel space
TEMPLATE = pathlib.Path('/usr/share/catkin/cmake/templates/__init__.py.in')
GEOMETRY = {'geometry_msgs': ['/usr/share/geometry_msgs/msg']}
SPACES = 'devel', 'install', 'debian'


def build(space, root):
    """Build all packages into a space below the folder; returns the folder for ``sys.path``."""
    packages = root / space / 'lib' / 'python3' / 'dist-packages'
    shutil.copytree(SOURCES, root / 'src')
    for source in sorted((root / 'src').iterdir()):
        package = packages / source.name
        code = source / 'src' / source.name
        if space == 'devel':
            package.mkdir(parents=True)
            relay = TEMPLATE.read_text().replace('@PACKAGE_PYTHONPATH@', str(source / 'src'))
            (package / '__init__.py').write_text(relay)
        else:
            shutil.copytree(code, package)
            share = root / space / 'share' / source.name
            share.mkdir(parents=True)
            shutil.copy(source / 'package.xml', share)
        for kind in 'msg', 'srv':
            if (source / kind).is_dir():
                _generate(source, kind, package / kind)
    return packages


def _generate(source, kind, folder):
    """What genpy writes for the messages or services of a package."""
    folder.mkdir()
    search = {source.name: [str(source / 'msg')], **GEOMETRY}
    generate = msg_generator if kind == 'msg' else srv_generator
    load = getattr(genmsg.msg_loader, f'load_{kind}_from_file')
    names = sorted(path.stem for path in (source / kind).iterdir())
    for name in names:
        context = genmsg.MsgContext.create_default()
        spec = load(context, str(source / kind / f'{name}.{kind}'), f'{source.name}/{name}')
        genmsg.msg_loader.load_depends(context, spec, search)
        lines = '\n'.join(generate(context, spec, search))
        (folder / f'_{name}.py').write_text(lines + '\n')
    (folder / '__init__.py').write_text(''.join(f'from ._{name} import *\n' for name in names))


def forget(prefix='robot_'):
    """Have Python import the packages anew."""
    for name in [name for name in sys.modules if name.startswith(prefix)]:
        del sys.modules[name]
