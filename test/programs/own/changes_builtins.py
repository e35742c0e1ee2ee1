#!/usr/bin/python3
"""A program that has builtins of its own, and ends by one."""
import builtins
import gettext

gettext.install('nothing')
builtins.answer = 42
said = []
builtins.print = said.append
print((_('hello'), answer))  # noqa: F821
__builtins__.question = 'what'
found = question  # noqa: F821
exit('enough')
