#!/usr/bin/python3
"""A program whose main thread runs a coroutine, until Ctrl-C."""
import asyncio
import threading

import rospy

ended = []
begun = threading.Event()


async def main():
    """Wait for ever."""
    try:
        begun.set()
        await asyncio.get_running_loop().create_future()
    finally:
        ended.append('in order')


rospy.init_node('runs_a_coroutine', disable_signals=True)
asyncio.run(main())
