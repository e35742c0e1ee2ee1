"""Read by catkin_python_setup() in CMakeLists.txt; version, texts and URLs are those of package.xml."""
from catkin_pkg.package import parse_package
from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import find_packages, setup

metadata = generate_distutils_setup(
    packages=find_packages('src'),
    package_dir={'': 'src'},
    package_data={'pharos': ['py.typed']},
    project_urls={url.type: url.url for url in parse_package('.').urls},
)
metadata['name'] = 'pharos-ros'  # PyPI has another package called pharos
setup(**metadata)
