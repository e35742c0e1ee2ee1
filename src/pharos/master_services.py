"""The services at a ROS master: which there are, and how one is found, or waited for."""
import functools
import time
from typing import TYPE_CHECKING, Any, List, Optional, cast

import rosgraph

from pharos.errors import MasterUnreachableError, ServiceCallError, UnknownServiceError, suggest
from pharos.master_calls import TIMEOUT, MasterCalls
from pharos.private_rospy.deadlines import MARGIN, time_limit
from pharos.seconds import check_limit
from pharos.service import Service
from pharos.wrong_guesses import tells_keywords

if TYPE_CHECKING:
    from pharos.master import Master

PATIENCE = 1.0  # seconds that a provider may take to answer a look of those who wait for it


class MasterServices(MasterCalls):
    """What a Master knows of services."""

    @property
    def _master(self) -> 'Master':
        return cast('Master', self)  # this class is a part of it

    def services(self) -> List[str]:
        """Names of all services."""
        return sorted(self.system_state()[2])

    @tells_keywords
    def lookup_service(
        self,
        name: str,
        caller_id: str = '/pharos',
        persistent: bool = False,
        wait: Optional[float] = 0,
    ) -> Service:
        """The :class:`Service` of that name, to be called in the name of ``caller_id``.

        The report (listing 3.5): ``master lookupService: '/clear' with: '/myID'``. It knows nothing
        of a node's namespace and remappings: in a node, :meth:`Node.lookup_service` does. A provider that
        says nothing for a quarter of a second, because it is busy or stopped, is not waited for: it
        is asked for its type again when that is needed, for a call for one.

        :param persistent: keep connections between calls; they are opened again when the provider
            comes back
        :param wait: seconds to wait until it is offered, as :meth:`wait_for_service` does; None:
            without limit
        :raises UnknownServiceError: if nobody offers it
        :raises ServiceCallError: if nobody is there any more where the master says that it is
        :raises MasterUnreachableError: if the master does not answer
        """
        caller_id = self.name_of(caller_id, 'node')
        name = self.name_of(name, 'service', caller_id)
        if wait == 0:
            return Service(self._master, name, caller_id, persistent)
        return _Awaited(self._master, name, caller_id, persistent).wait(check_limit('wait', wait))

    @tells_keywords
    def wait_for_service(
        self, name: str, timeout: Optional[float] = None, caller_id: str = '/pharos'
    ) -> Service:
        """Wait until a service of that name is offered, and its provider answers; returns it.

        :param timeout: seconds, None: without limit, 0: whether it is there now
        :param caller_id: as in :meth:`lookup_service`
        :raises UnknownServiceError: if nobody has offered it in time
        :raises ServiceCallError: if its provider has not answered in time
        :raises MasterUnreachableError: if the master does not answer for 5 seconds on end, or in
            that time
        :raises NodeStoppedError: if the node whose soul or delegate waits stops meanwhile
        """
        caller_id = self.name_of(caller_id, 'node')
        name = self.name_of(name, 'service', caller_id)
        return _Awaited(self._master, name, caller_id).wait(check_limit('timeout', timeout))


class _Awaited:
    """A service that somebody waits for.

    :param args: those of the Service
    """

    def __init__(self, master: 'Master', name: str, *args: Any) -> None:
        self._master, self._name = master, name
        self._make = functools.partial(Service, master, name, *args)
        self._answered = time.monotonic()  # when the master last did

    def wait(self, timeout: Optional[float]) -> Service:
        """See :meth:`MasterServices.wait_for_service`."""
        with time_limit(timeout):
            found: Optional[Service] = self._master.look_until_found(
                self._look, timeout, self._name
            )
        if found is not None:
            return found
        try:
            with time_limit(MARGIN):  # the last look was cut off, and tells nothing
                return self._find()
        except UnknownServiceError as error:
            hint = suggest(self._name, self._master.services())
            raise UnknownServiceError(
                f'no node offered {self._name} within {timeout:g} s{hint}: is it started, with the'
                f' master {self._master.url}, and does it offer that name?'
            ) from error

    def _look(self) -> Optional[Service]:
        """The service, if it is there by now."""
        try:
            self._master.call('lookupService', self._name)  # without the near ones, which cost more
            return self._find()
        except MasterUnreachableError:
            if time.monotonic() - self._answered >= TIMEOUT:
                raise
            return None  # it may be restarting
        except (rosgraph.MasterError, UnknownServiceError, ServiceCallError):
            self._answered = time.monotonic()
            return None

    def _find(self) -> Service:
        service = self._make(patience=PATIENCE)
        if not service.is_described:
            raise ServiceCallError(
                f'the provider of {self._name} at {service.uri} does not answer: is it busy, or'
                ' stopped?'
            )
        return service
