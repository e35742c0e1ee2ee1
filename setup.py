"""Read by catkin_python_setup() in CMakeLists.txt; name and version are those of package.xml."""
from catkin_pkg.python_setup import generate_distutils_setup
from setuptools import setup

setup(
    **generate_distutils_setup(
        packages=[
            'pharos',
            'pharos.commands',
            'pharos.compose',
            'pharos.intraprocess',
            'pharos.live',
            'pharos.messages',
            'pharos.new_package',
            'pharos.private_rospy',
            'pharos.private_rospy.patches',
            'pharos_turtle',
        ],
        package_dir={'': 'src'},
        package_data={'pharos': ['py.typed']},
    )
)
