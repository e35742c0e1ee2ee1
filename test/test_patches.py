"""The table of what is mended in rospy."""
import pathlib
import runpy
import types

import pytest

from pharos.errors import PharosError
from pharos.private_rospy.patches import table
from pharos.private_rospy.process_rospy import rospy

TOOL = runpy.run_path(str(pathlib.Path(__file__).resolve().parent.parent / 'tools' / 'patches'))

SOURCE = """
import time

def double(number, times=2):
    return number * times

def apivalidate(f):
    def validated_f(*args):
        return ('checked', f(*args))
    return validated_f

class Base:
    def inherited(self, value):
        return 'inherited', value

class Handler(Base):
    @apivalidate
    def call(self, caller_id):
        return 'called by ' + caller_id
"""


@pytest.fixture
def entries(monkeypatch):
    """An empty table."""
    monkeypatch.setattr(table, 'TABLE', [])


def patched(node=None):
    """A module made of the source above, with the patches of the table."""
    module = types.ModuleType('rospy.example')
    exec(SOURCE, vars(module))
    table.apply(module, node)
    return module


@pytest.mark.usefixtures('entries')
class TestTheTable:
    def test_a_patch_gets_its_node_the_original_and_the_private_module(self):
        @table.patch('rospy.example', 'double', 'doubles')
        def double(number, times=2, *, node, original, module):
            return node, module, original(number, times)

        module = patched('a node')
        assert module.double(3) == ('a node', module, 6)

    def test_each_node_has_patches_of_its_own(self):
        @table.patch('rospy.example', 'double', 'doubles')
        def double(number, times=2, *, node):
            return node

        one, other = patched('one'), patched('other')
        assert one.double(1) == 'one'
        assert other.double(1) == 'other'

    def test_a_method_that_is_inherited_is_replaced_where_the_patch_says(self):
        @table.patch('rospy.example', 'Handler.inherited', 'is inherited')
        def inherited(self, value, *, original):
            return original(self, value) + ('patched',)

        module = patched()
        assert module.Handler().inherited(1) == ('inherited', 1, 'patched')
        assert module.Base().inherited(1) == ('inherited', 1)

    def test_rospy_goes_on_checking_the_arguments_of_a_remote_call(self):
        @table.patch('rospy.example', 'Handler.call', 'says too little')
        def call(self, caller_id, *, original):
            return original(self, caller_id) + ', patched'

        assert patched().Handler().call('me') == ('checked', 'called by me, patched')

    def test_a_function_is_added_to_a_class(self):
        @table.addition('rospy.example', 'Handler.more', 'is missing')
        def more(self, *, node):
            return self, node

        handler = patched('a node').Handler()
        assert handler.more() == (handler, 'a node')

    def test_a_name_of_a_module_is_substituted(self):
        @table.substitute('rospy.example', 'time', 'waits for long')
        def time(*, node, original):
            return node, original.__name__

        assert patched('a node').time == ('a node', 'time')

    @pytest.mark.parametrize('target', ['gone', 'Gone.method', 'Handler.gone'])
    def test_a_target_that_is_missing_is_named_with_its_patch(self, target):
        @table.patch('rospy.example', target, 'is gone')
        def mended():
            """Never called."""

        with pytest.raises(
            PharosError, match=rf'test_patches\.mended .*rospy\.example\.{target} is not there'
        ):
            patched()

    def test_a_target_with_other_parameters_is_named_with_its_patch(self):
        @table.patch('rospy.example', 'Handler.call', 'takes more')
        def mended(self, caller_id, message):
            """Never called."""

        with pytest.raises(
            PharosError,
            match=r'mended .*Handler\.call takes \(self, caller_id\), not \(self, caller_id, mess',
        ):
            patched()

    def test_what_is_no_function_cannot_be_patched_as_one(self):
        @table.patch('rospy.example', 'Handler', 'is a class')
        def mended():
            """Never called."""

        with pytest.raises(PharosError, match=r'rospy\.example\.Handler is no function'):
            patched()

    def test_an_addition_to_a_class_that_has_it_by_now_is_an_error(self):
        @table.addition('rospy.example', 'Handler.call', 'is missing')
        def mended(self):
            """Never called."""

        with pytest.raises(PharosError, match=r'mended .*Handler\.call is there already'):
            patched()

    def test_a_target_has_one_patch(self):
        table.patch('rospy.example', 'double', 'doubles')(lambda: None)
        with pytest.raises(PharosError, match=r'rospy\.example\.double has two patches'):
            table.patch('rospy.example', 'double', 'doubles')(lambda: None)

    def test_a_patch_of_a_module_that_is_never_loaded_is_an_error(self):
        table.patch('rospy.gone', 'double', 'doubles')(patched)
        with pytest.raises(PharosError, match=r'patched .*rospy\.gone\.double is not there'):
            table.check_applied({'rospy.example': None})


class TestWhatIsPatched:
    """What rospy has there, as tools/patches sees it."""

    def test_it_is_what_it_is_in_a_release_that_is_known(self):
        """A new release of rospy is known when each target that this names was looked at, its patch
        fits, and ``tools/patches RELEASE FOLDER`` has noted the release (it says how)."""
        _, known = TOOL['read_notes']()
        found = TOOL['fingerprints'](pathlib.Path(rospy.__file__).parent.parent)
        changed = [
            target
            for target, fingerprint in found.items()
            if fingerprint == TOOL['UNKNOWN'] or fingerprint not in known.get(target, {}).values()
        ]
        assert changed == [], 'rospy has others than known: see the docstring of this test'
        assert found.keys() == known.keys(), 'run tools/patches RELEASE FOLDER'

    def test_the_page_of_the_documentation_shows_the_table(self):
        assert TOOL['PAGE'].read_text() == TOOL['page'](), 'run tools/patches'
