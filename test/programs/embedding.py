"""A program with a master of its own; then it does what its argument says."""
import os
import signal  # noqa: F401
import sys
import time  # noqa: F401
import threading  # noqa: F401

from pharos import BlockNode, Master

os.setpgrp()  # as a shell starts it
master = Master.embedded()
master.create(BlockNode, named='/n')
print('URL', master.url, master.pid, flush=True)
exec(sys.argv[1])
