"""A service type that is defined otherwise here than at its provider: refused, as ROS refuses it,
and explained."""
import contextlib
import sys

import pytest

import pharos
from pharos import BlockNode, ServiceTypeError
from pharos import messages
from programs import PROGRAMS, Program, script

TYPE = 'layout_srvs/Spawn'
X_FIRST = 'float32 x\nfloat32 y\n---\nstring name\n'
Y_FIRST = 'float32 y\nfloat32 x\n---\nstring name\n'
MORE = X_FIRST.replace('x\n', 'x\nfloat32 theta\n')
FIELDS = {
    X_FIRST: 'request: x: float32, y: float32; response: name: string',
    Y_FIRST: 'request: y: float32, x: float32; response: name: string',
    MORE: 'request: x: float32, theta: float32, y: float32; response: name: string',
}

persistent_or_not = pytest.mark.parametrize(
    'persistent', [False, True], ids=['plain', 'persistent']
)


def class_of(text):
    """The class of that text, with nothing defined for later."""
    return messages.definition.make('srv', TYPE, text)


@pytest.fixture
def defined(monkeypatch):
    """``defined(text)``: that is what the type is here, until the test ends."""

    def define(text):
        monkeypatch.setitem(messages.lookup.found, ('srv', TYPE), class_of(text))

    return define


@pytest.fixture(params=['rospy', 'here'])
def provide(request, master):
    """``provide(text)``: have a service /layouts/spawn of that definition, in place of the one
    before."""
    with contextlib.ExitStack() as provided:

        def provide(text):
            provided.close()
            if request.param == 'rospy':
                program = provided.enter_context(
                    Program(master.url, sys.executable, PROGRAMS / 'spawn_provider.py', text)
                )
                assert class_of(text)._md5sum in program.wait_for('ready')
            else:
                node = provided.enter_context(
                    master.create(BlockNode, named='/layouts_here', domain='127.0.0.1')
                )
                node.serve(
                    '/layouts/spawn', class_of(text), lambda request: f'{request.x:g} {request.y:g}'
                )

        provide.knows_fields = request.param == 'here'
        yield provide


@persistent_or_not
@pytest.mark.parametrize('ours, theirs', [(Y_FIRST, X_FIRST), (X_FIRST, MORE)])
def test_fields_in_another_order_are_refused_with_both_definitions(
    master, defined, provide, ours, theirs, persistent
):
    defined(ours)
    provide(theirs)
    service = master.lookup_service('/layouts/spawn', persistent=persistent)
    for timeout in None, 20:
        with pytest.raises(ServiceTypeError) as error:
            service.call(x=1, y=9, timeout=timeout)
        assert str(error.value) == (
            f'/layouts/spawn is of type {TYPE} with md5sum {class_of(theirs)._md5sum} '
            f'({FIELDS[theirs] if provide.knows_fields else "its fields are not known here"}), but {TYPE} is defined '
            f'here with md5sum {class_of(ours)._md5sum} ({FIELDS[ours]}), so nothing was sent: have both sides use the '
            'same Spawn.srv'
        )
    assert service.response is None
    defined(theirs)  # the same definition, at last
    assert service.call(x=1, y=9).name == '1 9'
    service.close()


@persistent_or_not
def test_a_field_that_the_providers_definition_alone_has_is_told_as_such(
    master, defined, provide, persistent
):
    defined(X_FIRST)
    provide(MORE)
    with pytest.raises(ServiceTypeError, match='is of type layout_srvs/Spawn with md5sum'):
        master.lookup_service('/layouts/spawn', persistent=persistent).call(x=1, theta=9)


@persistent_or_not
def test_an_md5sum_by_hand_is_sent_though_the_definition_is_another(
    master, defined, provide, persistent
):
    defined(Y_FIRST)
    provide(X_FIRST)
    service = master.lookup_service('/layouts/spawn', persistent=persistent)
    for by_hand in service.md5sum, '*':
        service.md5sum = by_hand
        assert service.call(x=1, y=9).name == '9 1'  # as was asked for
    service.md5sum = class_of(Y_FIRST)._md5sum
    with pytest.raises(ServiceTypeError, match='set that one, or none'):
        service.call(x=1, y=9)
    service.md5sum = None
    assert service.md5sum == class_of(X_FIRST)._md5sum
    with pytest.raises(ServiceTypeError, match='so nothing was sent'):
        service.call(x=1, y=9)
    service.close()


@persistent_or_not
def test_a_provider_that_changes_its_definition_between_calls(master, defined, provide, persistent):
    defined(X_FIRST)
    provide(X_FIRST)
    service = master.lookup_service('/layouts/spawn', persistent=persistent)
    assert service.call(x=1, y=9).name == '1 9'
    provide(Y_FIRST)
    with pytest.raises(
        ServiceTypeError, match=f'with md5sum {class_of(Y_FIRST)._md5sum} .*so nothing was sent'
    ):
        service.call(x=1, y=9)
    provide(X_FIRST)
    assert service.call(x=1, y=9).name == '1 9'
    service.close()


@persistent_or_not
def test_a_provider_that_takes_on_our_definition_is_called_without_another_look_up(
    master, defined, provide, persistent
):
    defined(Y_FIRST)
    provide(X_FIRST)
    service = master.lookup_service('/layouts/spawn', persistent=persistent)
    provide(Y_FIRST)
    assert service.call(x=1, y=9).name == '1 9'
    assert service.md5sum == class_of(Y_FIRST)._md5sum
    service.close()


CALLER = r'''
import pharos
service = pharos.Master().lookup_service('/spawn')
try:
    print(service.call(x=1, y=9))
except pharos.ServiceTypeError as error:
    print(error)
'''


def test_a_turtle_is_not_spawned_elsewhere_by_a_srv_file_of_another_order(master, tmp_path):
    (tmp_path / 'turtlesim' / 'srv').mkdir(parents=True)
    (tmp_path / 'turtlesim' / 'package.xml').write_text(
        '<package><name>turtlesim</name><version>0.0.0</version><description/><maintainer email="a@b.c">a</maintainer>'
        '<license>BSD</license></package>'
    )
    (tmp_path / 'turtlesim' / 'srv' / 'Spawn.srv').write_text(
        'float32 y\nfloat32 x\nfloat32 theta\nstring name\n---\nstring name\n'
    )
    with Program(master.url, script('turtle_simulator'), cwd=tmp_path) as simulator:
        simulator.wait_for('Spawning turtle [turtle1]')
        with Program(
            master.url, sys.executable, '-c', CALLER, ROS_PACKAGE_PATH=str(tmp_path)
        ) as caller:
            said = caller.read_to_the_end()
        assert '/turtle2/set_pen' not in master.services()
    # the order that the simulator has is the one that this package ships
    assert (
        'request: x: float32, y: float32, theta: float32, name: string; response: name: string), but'
        in said
    )
    assert (
        'request: y: float32, x: float32, theta: float32, name: string; response: name: string), so'
        in said
    )


def test_a_block_that_returns_a_response_of_another_definition_is_told(master, defined, transcript):
    node = master.create(BlockNode, named='/layouts_here', domain='127.0.0.1')
    text = '---\nint32 a\nint32 b\n'
    mine, other = class_of(text), class_of('---\nint32 b\nint32 a\n')
    defined(text)
    node.serve('/layouts/answer', mine, lambda request: other._response_class(a=1, b=2))
    with pytest.raises(
        pharos.ServiceCallError,
        match='answers with a layout_srvs/SpawnResponse of a: int32, b: int32',
    ):
        master.lookup_service('/layouts/answer').call()
