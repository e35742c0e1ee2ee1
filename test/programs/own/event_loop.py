#!/usr/bin/python3
"""A program that uses the event loop of its main thread, as Python makes it."""
import asyncio

import rospy


async def say():
    """What is run in the loop."""
    await asyncio.sleep(0.001)
    return 'done'


rospy.init_node('event_loop')
rospy.set_param('~said', asyncio.get_event_loop().run_until_complete(say()))
