"""Hears twenty images from another process, and prints how many pages the system gave from one to the
next, in the middle."""
import resource
import statistics
import threading

from pharos import BlockNode, Master

pages, done = [], threading.Event()


def count(message, channel):
    pages.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
    if len(pages) == 20:
        done.set()


node = Master().create(BlockNode, named='/hears_images')
node.interested_in('/images', 'sensor_msgs/Image', count)
done.wait()
print('pages', statistics.median(after - before for before, after in zip(pages, pages[1:])))
node.stop()
