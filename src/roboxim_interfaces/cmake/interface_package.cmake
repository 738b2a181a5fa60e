# Build one interface package: find its dependencies, generate code from msg/, srv/ and action/, export it.
#
#   interface_package(DEPENDENCIES <package>...)
#
# Interface files are globbed with CONFIGURE_DEPENDS, so no list needs a change when one is added or removed.
#
# These packages build against either of:
# - an ordinary ROS 2 installation (colcon): nothing special happens;
# - the ROS wheels of PyPI (-DROBOXIM_ROS_FROM_WHEELS=ON): see cmake/ros_from_wheels.cmake.

option(ROBOXIM_ROS_FROM_WHEELS "ROS 2 comes from PyPI wheels in the prefix of Python3_EXECUTABLE" OFF)

if(ROBOXIM_ROS_FROM_WHEELS)
  include("${CMAKE_CURRENT_LIST_DIR}/ros_from_wheels.cmake")
endif()

macro(interface_package)
  cmake_parse_arguments(_interface "" "" "DEPENDENCIES" ${ARGN})

  if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)
    set(CMAKE_BUILD_TYPE Release)
  endif()

  find_package(ament_cmake REQUIRED)
  find_package(rosidl_default_generators REQUIRED)
  foreach(_dependency IN LISTS _interface_DEPENDENCIES)
    find_package(${_dependency} REQUIRED)
  endforeach()

  file(GLOB _interface_files CONFIGURE_DEPENDS RELATIVE "${CMAKE_CURRENT_SOURCE_DIR}"
    "${CMAKE_CURRENT_SOURCE_DIR}/msg/*.msg"
    "${CMAKE_CURRENT_SOURCE_DIR}/srv/*.srv"
    "${CMAKE_CURRENT_SOURCE_DIR}/action/*.action")
  if(NOT _interface_files)
    message(FATAL_ERROR "${PROJECT_NAME} has no .msg, .srv or .action file in ${CMAKE_CURRENT_SOURCE_DIR}")
  endif()

  interface_package_check_dependencies("${_interface_files}" "${_interface_DEPENDENCIES}")

  if(ROBOXIM_ROS_FROM_WHEELS)
    ros_from_wheels_before_generate()
  endif()
  rosidl_generate_interfaces(${PROJECT_NAME} ${_interface_files} DEPENDENCIES ${_interface_DEPENDENCIES})
  if(ROBOXIM_ROS_FROM_WHEELS)
    ros_from_wheels_after_generate()
  endif()
  ament_export_dependencies(rosidl_default_runtime)
  ament_package()
endmacro()

# Refuse a message of a package that is not a dependency, naming the package (rosidl raises a bare KeyError).
function(interface_package_check_dependencies files dependencies)
  foreach(_file IN LISTS files)
    file(STRINGS "${CMAKE_CURRENT_SOURCE_DIR}/${_file}" _fields REGEX "^ *[a-z][a-z0-9_]*/[A-Z]")
    foreach(_field IN LISTS _fields)
      string(REGEX REPLACE "^ *([a-z0-9_]+)/.*" "\\1" _package "${_field}")
      if(NOT _package IN_LIST dependencies AND NOT _package STREQUAL PROJECT_NAME)
        message(FATAL_ERROR "${PROJECT_NAME}/${_file} uses ${_package}: add it to DEPENDENCIES in CMakeLists.txt, "
          "to package.xml and to the requirements in pyproject.toml")
      endif()
    endforeach()
  endforeach()
endfunction()
