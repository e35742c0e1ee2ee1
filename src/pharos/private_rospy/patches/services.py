"""Calls of services: without a socket where the provider is of this process."""
import math

from pharos.intraprocess.services import Failed
from pharos.intraprocess.sharing import numbered
from pharos.private_rospy import local_services
from pharos.private_rospy.lifetime import Interruption
from pharos.private_rospy.patches.table import substitute


@substitute(
    'rospy.impl.tcpros_service', 'TCPROSTransport', 'has no way to a provider of the same process'
)
def service_transport(*, node, module):
    """A transport that takes that way where it can; to ServiceProxy, it is as over a socket.

    What a provider refuses is sent through a socket, and so refused in rospy's own words.
    """

    class ServiceTransport(module.TCPROSTransport):
        """From a caller to a provider, or to a caller from a provider elsewhere."""

        local = None  # the service, where it is of this process

        def connect(self, dest_addr, dest_port, endpoint_id, timeout=None):
            protocol = self.protocol
            self.sent = fields = protocol.get_header_fields()
            if 'probe' not in fields and all(type(value) is str for value in fields.values()):
                self.local = local_services.find(
                    self.name, endpoint_id, protocol.service_class, fields['md5sum']
                )
            if self.local is None:
                super().connect(dest_addr, dest_port, endpoint_id, timeout)
                return
            self._validate_header(self.local.header)
            if fields.get('persistent', '').lower() in ('1', 'true'):
                self.local.keep_thread()

        def close(self):
            super().close()
            self.local = None

        def send_message(self, msg, seq):
            if self.local is None or self.done:
                super().send_message(msg, seq)
            else:
                self.request = self.local.freeze(numbered(msg, seq))

        def receive_once(self):
            if self.local is None:
                return super().receive_once()
            try:
                with Interruption(lambda: None, node.lifetime):  # ends the wait in call()
                    return [self.local.call(self.request, self.sent, math.inf)]
            except Failed as error:
                raise module.ServiceException(
                    'service [%s] responded with an error: %s' % (self.name, str(error).encode())
                ) from None
            except ConnectionError as error:
                self.close()
                raise module.TransportTerminated(
                    "unable to receive data from sender, check sender's logs for details"
                ) from error

    return ServiceTransport
