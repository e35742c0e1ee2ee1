# flake8: noqa: E501
"""Edits of small programs. Each sends 1 before the edit, and 2 after it.

A name -> definitions, lines of main(), pairs of a former and a new text, and other files: their texts
before and after.
"""
T = '''#!/usr/bin/python3
import rospy
from std_msgs.msg import Float64
%s
def main():
    global out, keep
    rospy.init_node('case')
    out = rospy.Publisher('out', Float64, queue_size=1000)
%s
    rospy.spin()
if __name__ == '__main__':
    main()
'''
SUB = "rospy.Subscriber('in', Float64, %s, queue_size=1000)"
E = {}


def e(name, defs, setup, *edits, files=None):
    E[name] = (defs, setup, edits, files or {})


SEE = "def see(m):\n    out.publish(%s)\n"
e('function body', SEE % '1.0', SUB % 'see', ('1.0', '2.0'))
e('module constant', 'GAIN = 1.0\n' + SEE % 'GAIN', SUB % 'see', ('GAIN = 1.0', 'GAIN = 2.0'))
e(
    'constant from a constant',
    'A = 1.0\nB = A * 1.0\n' + SEE % 'B',
    SUB % 'see',
    ('A = 1.0', 'A = 2.0'),
)
e('annotated constant', 'A: float = 1.0\n' + SEE % 'A', SUB % 'see', ('1.0', '2.0'))
e('tuple constants', 'A, B = 1.0, 5.0\n' + SEE % 'A', SUB % 'see', ('1.0', '2.0'))
e(
    'constant in try import',
    'try:\n    import json\n    A = 1.0\nexcept ImportError:\n    pass\n' + SEE % 'A',
    SUB % 'see',
    ('1.0', '2.0'),
)
e('augmented constant', 'A = 0.0\nA += 1.0\n' + SEE % 'A', SUB % 'see', ('A += 1.0', 'A += 2.0'))
e(
    'dict constant held elsewhere',
    "P = {'k': 1.0}\nclass C:\n    def __init__(self):\n        self.p = P\n    def see(self, m):\n        out.publish(self.p['k'])\n",
    '    c = C(); ' + SUB % 'c.see',
    ('1.0', '2.0'),
)
e(
    'default argument',
    'def f(x, k=1.0):\n    return k\n' + SEE % 'f(0)',
    SUB % 'see',
    ('k=1.0', 'k=2.0'),
)
e(
    'new parameter and its callers',
    'def f():\n    return 1.0\n' + SEE % 'f()',
    SUB % 'see',
    ('def f():\n    return 1.0', 'def f(k):\n    return k'),
    ('f()', 'f(2.0)'),
)
e(
    'default of a changed constant',
    'G = 1.0\ndef f(x=G):\n    return x\n' + SEE % 'f()',
    SUB % 'see',
    ('G = 1.0', 'G = 2.0'),
)
DEC = "import functools\ndef twice(f):\n    @functools.wraps(f)\n    def w(m):\n        return f(m)\n    return w\n"
e(
    'decorator body',
    "import functools\ndef scale(f):\n    @functools.wraps(f)\n    def w(m):\n        return f(1.0)\n    return w\n@scale\ndef see(m):\n    out.publish(m)\n",
    SUB % 'see',
    ('f(1.0)', 'f(2.0)'),
)
e(
    'decorator without wraps',
    "def deco(f):\n    def w(m):\n        return f(m)\n    return w\n@deco\n" + SEE % '1.0',
    SUB % 'see',
    ('1.0', '2.0'),
)
e(
    'decorator added',
    DEC.replace('return f(m)', 'm.data = 2.0; return f(m)')
    + "def see(m):\n    out.publish(m.data)\n",
    SUB % 'see',
    ('def see', '@twice\ndef see'),
)
e(
    'argument of a decorator',
    "import functools\ndef send(value):\n    def decorate(f):\n        @functools.wraps(f)\n        def w(m):\n            return f(value)\n"
    "        return w\n    return decorate\n@send(1.0)\ndef see(m):\n    out.publish(m)\n",
    SUB % 'see',
    ('@send(1.0)', '@send(2.0)'),
)
e(
    'lru_cache function',
    "import functools\n@functools.lru_cache()\ndef f():\n    return 1.0\n" + SEE % 'f()',
    SUB % 'see',
    ('return 1.0', 'return 2.0'),
)
e('lambda in main', '', SUB % 'lambda m: out.publish(1.0)', ('publish(1.0)', 'publish(2.0)'))
e('lambda constant', 'f = lambda: 1.0\n' + SEE % 'f()', SUB % 'see', ('1.0', '2.0'))
e(
    'partial',
    "import functools\ndef see(k, m):\n    out.publish(1.0 * k)\n",
    SUB % 'functools.partial(see, 1.0)',
    ('1.0 * k', '2.0 * k'),
)
K = "class C:\n    K = 1.0\n    def __init__(self):\n        self.n = 0\n    def see(self, m):\n        self.n += 1\n        out.publish(self.f())\n    def f(self):\n        return %s\n"
MK = '    keep = c = C(); ' + SUB % 'c.see'
e('method body', K % '1.0', MK, ('return 1.0', 'return 2.0'))
e('class attribute', K % 'self.K', MK, ('K = 1.0', 'K = 2.0'))
e(
    'property',
    K.replace('    def f(self)', '    @property\n    def g(self)').replace('self.f()', 'self.g')
    % '1.0',
    MK,
    ('return 1.0', 'return 2.0'),
)
e(
    'staticmethod',
    K.replace('    def f(self)', '    @staticmethod\n    def f()') % '1.0',
    MK,
    ('return 1.0', 'return 2.0'),
)
e(
    'classmethod',
    K.replace('    def f(self)', '    @classmethod\n    def f(cls)') % '1.0',
    MK,
    ('return 1.0', 'return 2.0'),
)
e(
    'method removed (super has it)',
    "class B:\n    def f(self):\n        return 2.0\nclass C(B):\n    def see(self, m):\n        out.publish(self.f())\n    def f(self):\n        return 1.0\n",
    MK,
    ('    def f(self):\n        return 1.0\n', ''),
)
e(
    'callback renamed',
    K % '1.0',
    MK,
    ('def see', 'def hear'),
    ('c.see', 'c.hear'),
    ('return 1.0', 'return 2.0'),
)
e(
    'super() method',
    "class B:\n    def f(self):\n        return 1.0\nclass C(B):\n    def see(self, m):\n        out.publish(self.f())\n    def f(self):\n        return super().f() * 1.0\n",
    MK,
    ('* 1.0', '* 2.0'),
)
e(
    'super() method added',
    "class B:\n    def f(self):\n        return 1.0\nclass C(B):\n    def see(self, m):\n        out.publish(self.f())\n",
    MK,
    ('class C(B):\n', 'class C(B):\n    def f(self):\n        return super().f() * 2.0\n'),
)
e(
    'superclass body',
    "class B:\n    def f(self):\n        return 1.0\nclass C(B):\n    def see(self, m):\n        out.publish(self.f())\n",
    MK,
    ('1.0', '2.0'),
)
e(
    'base class changed',
    "class A:\n    def f(self):\n        return 1.0\nclass B:\n    def f(self):\n        return 2.0\nclass C(A):\n    def see(self, m):\n        out.publish(self.f())\n",
    MK,
    ('class C(A)', 'class C(B)'),
)
e(
    '__init__ attribute',
    "class C:\n    def __init__(self):\n        self.k = 1.0\n    def see(self, m):\n        out.publish(self.k)\n",
    MK,
    ('1.0', '2.0'),
)
e(
    'new Subscriber in __init__',
    "class C:\n    def __init__(self):\n        pass\n    def see(self, m):\n        out.publish(1.0)\n",
    MK,
    ("        pass\n", "        rospy.Subscriber('in2', Float64, self.see)\n"),
)
e(
    'dataclass default',
    "import dataclasses\n@dataclasses.dataclass\nclass P:\n    k: float = 1.0\n" + SEE % 'P().k',
    SUB % 'see',
    ('1.0', '2.0'),
)
e(
    'namedtuple default',
    "from collections import namedtuple\nP = namedtuple('P', 'k', defaults=[1.0])\n"
    + SEE % 'P().k',
    SUB % 'see',
    ('[1.0]', '[2.0]'),
)
e(
    'Enum value',
    "import enum\nclass S(enum.Enum):\n    A = 1.0\n" + SEE % 'S.A.value',
    SUB % 'see',
    ('1.0', '2.0'),
)
e(
    'Enum member added',
    "import enum\nclass S(enum.Enum):\n    A = 1.0\n" + SEE % 'S.A.value',
    SUB % 'see',
    ('    A = 1.0', '    A = 1.0\n    B = 2.0'),
    ('S.A.value', 'S.B.value'),
)
e(
    'nested function',
    "def see(m):\n    def f():\n        return 1.0\n    out.publish(f())\n",
    SUB % 'see',
    ('1.0', '2.0'),
)
e(
    'nested class',
    "class C:\n    class D:\n        def f(self):\n            return 1.0\n    def __init__(self):\n        self.d = self.D()\n    def see(self, m):\n        out.publish(self.d.f())\n",
    MK,
    ('1.0', '2.0'),
)
e(
    'generator',
    "def gen():\n    while True:\n        yield 1.0\n",
    "    g = gen(); " + SUB % 'lambda m: out.publish(next(g))',
    ('1.0', '2.0'),
)
e(
    'async function',
    "import asyncio\nasync def f():\n    return 1.0\n" + SEE % 'asyncio.run(f())',
    SUB % 'see',
    ('1.0', '2.0'),
)
e(
    'global state kept',
    "count = 0\ndef see(m):\n    global count\n    count += 1\n    out.publish(1.0 if count > 3 else 9.0)\n",
    SUB % 'see',
    ('1.0 if', '2.0 if'),
)
e(
    'comment above global state',
    "# a\nlog = []\ndef see(m):\n    log.append(1)\n    out.publish(1.0 if len(log) > 3 else 9.0)\n",
    SUB % 'see',
    ('# a', '# b\n\n'),
    ('1.0 if', '2.0 if'),
)
e(
    'new import',
    SEE % '1.0',
    SUB % 'see',
    ('import rospy\n', 'import rospy\nimport math\n'),
    ('publish(1.0)', 'publish(math.sqrt(4.0))'),
)
e(
    'main loop body',
    '',
    "    r = rospy.Rate(100)\n    while not rospy.is_shutdown():\n        out.publish(1.0); r.sleep()\n    return",
    ('1.0', '2.0'),
)
e(
    'main loop calls a function',
    'def step():\n    out.publish(1.0)\n',
    "    r = rospy.Rate(100)\n    while not rospy.is_shutdown():\n        step(); r.sleep()\n    return",
    ('1.0', '2.0'),
)
e(
    'timer callback',
    "def tick(e):\n    out.publish(1.0)\n",
    "    keep = rospy.Timer(rospy.Duration(0.01), tick)",
    ('1.0', '2.0'),
)
e(
    'thread loop',
    "import threading, time\ndef loop():\n    while not rospy.is_shutdown():\n        out.publish(1.0); time.sleep(0.01)\n",
    "    threading.Thread(target=loop, daemon=True).start()",
    ('1.0', '2.0'),
)
H = "import helper_%s as helper\n"
e(
    'helper constant by module',
    'import case_helper\n' + SEE % 'case_helper.K',
    SUB % 'see',
    files={'case_helper.py': ('K = 1.0\n', 'K = 2.0\n')},
)
e(
    'helper constant by from',
    'from case_helper import K\n' + SEE % 'K',
    SUB % 'see',
    files={'case_helper.py': ('K = 1.0\n', 'K = 2.0\n')},
)
e(
    'new file',
    SEE % '1.0',
    SUB % 'see',
    ('import rospy\n', 'import rospy\nimport case_new\n'),
    ('publish(1.0)', 'publish(case_new.f())'),
    files={'case_new.py': (None, 'def f():\n    return 2.0\n')},
)
e(
    'new name in helper by from',
    'from case_helper import f\n' + SEE % 'f()',
    SUB % 'see',
    ('import f\n', 'import f, g\n'),
    ('publish(f())', 'publish(g())'),
    files={
        'case_helper.py': (
            'def f():\n    return 1.0\n',
            'def f():\n    return 1.0\ndef g():\n    return 2.0\n',
        )
    },
)
e(
    'value and class default at once',
    'K = 1.0\nclass C:\n    k = K\n    def see(self, m):\n        out.publish(self.k)\n',
    MK,
    ('K = 1.0', 'K = 2.0'),
)
e(
    'value and class edited at once',
    'K = 1.0\nclass C:\n    k = K\n    def see(self, m):\n        out.publish(self.k)\n',
    MK,
    ('K = 1.0', 'K = 2.0'),
    ('k = K', 'k = K + 0'),
)
e(
    'callback class with __call__',
    "class C:\n    def __call__(self, m):\n        out.publish(1.0)\n",
    '    keep = c = C(); ' + SUB % 'c',
    ('1.0', '2.0'),
)
e(
    '__slots__ added attr',
    "class C:\n    __slots__ = ('k',)\n    def see(self, m):\n        out.publish(1.0)\n",
    MK,
    ('1.0', '2.0'),
)
e(
    'abstract base',
    "import abc\nclass B(abc.ABC):\n    @abc.abstractmethod\n    def f(self): pass\nclass C(B):\n    def see(self, m):\n        out.publish(self.f())\n    def f(self):\n        return 1.0\n",
    MK,
    ('1.0', '2.0'),
)
e(
    'overload of function twice',
    "def f():\n    return 1.0\ndef g():\n    return 2.0\n" + SEE % 'f()',
    SUB % 'see',
    ('def g():\n    return 2.0\n', 'def g():\n    return 2.0\nf = g\n'),
)
e(
    'statement moved (same text)',
    "K = 2.0\nK = 1.0\n" + SEE % 'K',
    SUB % 'see',
    ('K = 2.0\nK = 1.0\n', 'K = 1.0\nK = 2.0\n'),
)
e(
    'docstring in def, type hints',
    "def see(m: Float64) -> None:\n    'doc'\n    out.publish(1.0)\n",
    SUB % 'see',
    ('1.0', '2.0'),
)
e('if __name__ block', '', SUB % 'lambda m: out.publish(K)', ("    main()", "    K = 2.0; main()"))


def texts(name):
    defs, setup, edits, files = E[name]
    setup = setup if setup.startswith('    ') else '    ' + setup
    a = T % (defs, setup)
    if name == 'if __name__ block':
        a = a.replace("    main()\n", "    K = 1.0; main()\n")
        edits = [("K = 1.0", "K = 2.0")]
    if name == 'future annotations':
        a = a.replace('import rospy', 'from __future__ import annotations\nimport rospy', 1)
    b = a
    for old, new in edits:
        assert old in b, (name, old)
        b = b.replace(old, new)
    compile(a, name, 'exec')
    compile(b, name, 'exec')
    return a, b, files
