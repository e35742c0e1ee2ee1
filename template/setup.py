"""Read by catkin_python_setup() in CMakeLists.txt; name and version are those of package.xml."""
from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

setup(**generate_distutils_setup(packages=['my_package'], package_dir={'': 'src'}))
