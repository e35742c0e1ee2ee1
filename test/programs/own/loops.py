#!/usr/bin/python3
"""A program whose event loop ends by a signal."""
import asyncio
import signal
import threading

import rospy

ended = []
begun = threading.Event()


async def main():
    """Wait for Ctrl-C."""
    over = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGINT, over.set)
    begun.set()
    await over.wait()
    ended.append('by the signal')


rospy.init_node('loops')
asyncio.run(main())
