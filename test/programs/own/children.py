#!/usr/bin/python3
"""A program with an environment of its own, and children that see it."""
import multiprocessing
import os
import subprocess

ASK = ['sh', '-c', 'echo $ROS_NAMESPACE $OWN_VARIABLE']


def ask(queue):
    """What a child of multiprocessing finds."""
    queue.put([Answer(os.getenv('OWN_VARIABLE')), subprocess.check_output(ASK, text=True)])


class Answer:
    """A class that a child pickles, and its parent unpickles."""

    def __init__(self, text):
        self.text = text


os.environ['OWN_VARIABLE'] = 'own'
os.putenv('OWN_VARIABLE_TOO', 'too')
found = {
    'getenv': os.getenv('OWN_VARIABLE'),
    'expandvars': os.path.expandvars('$OWN_VARIABLE'),
    'subprocess': subprocess.check_output(ASK, text=True),
    'run': subprocess.run('echo $OWN_VARIABLE_TOO', shell=True, stdout=-1, text=True).stdout,
    'popen': os.popen('echo $OWN_VARIABLE').read(),
    'system': os.system('test "$OWN_VARIABLE" = own || exit 7'),
    'system_fails': os.WEXITSTATUS(os.system('exit 7')),
    'spawn': os.spawnlp(os.P_WAIT, 'sh', 'sh', '-c', 'test "$OWN_VARIABLE" = own'),
}
try:
    subprocess.check_call(['false'])
except subprocess.CalledProcessError as error:
    found['check_call'] = error.returncode
queue = multiprocessing.Queue()
child = multiprocessing.Process(target=ask, args=(queue,))
child.start()
answer, found['child_of_child'] = queue.get()
found['multiprocessing'] = answer.text
found['answer'] = isinstance(answer, Answer)
child.join()
found['exit_code'] = child.exitcode
queue.close()
queue.join_thread()
