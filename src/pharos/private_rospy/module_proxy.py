"""Look-alikes of modules."""
import types


class ModuleProxy:
    """A look-alike of a module: a few names of its own, everything else the real module's, as it is
    at the time."""

    __class__ = types.ModuleType  # type: ignore[assignment]  # for isinstance()

    def __init__(self, real, **own):
        self.__dict__.update(own, _real=real)

    def __getattr__(self, name):
        if name == '__all__' and not hasattr(self._real, name):  # star imports look into __dict__
            return [each for each in dir(self._real) if not each.startswith('_')]
        return getattr(self._real, name)

    def __dir__(self):
        return dir(self._real)


def twin(real, **own):
    """A copy of a module that has other objects under some names, which its functions see, too.

    Its classes are the real module's, so that their instances are of one kind everywhere.
    """
    module = types.ModuleType(real.__name__)
    space = vars(module)
    space.update(vars(real))
    space.update(own)  # before the functions, which take their builtins from here
    for name, value in vars(real).items():
        is_own_function = isinstance(value, types.FunctionType) and value.__globals__ is vars(real)
        # typing has some that are compared with themselves, by their attributes
        if is_own_function and name not in own and not vars(value):
            space[name] = copy = types.FunctionType(
                value.__code__, space, value.__name__, value.__defaults__, value.__closure__
            )
            copy.__kwdefaults__, copy.__doc__ = value.__kwdefaults__, value.__doc__
    return module
