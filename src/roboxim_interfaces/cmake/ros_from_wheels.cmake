# What the ROS wheels of PyPI need from a CMake project; included only when they are the ROS that is used.

# The wheels install into the prefix of the Python environment, which neither CMake nor ament searches by itself.
if(NOT Python3_EXECUTABLE)
  message(FATAL_ERROR "ROBOXIM_ROS_FROM_WHEELS needs -DPython3_EXECUTABLE=<python of the environment with the wheels>")
endif()
execute_process(
  COMMAND "${Python3_EXECUTABLE}" -c "import ament_package, pathlib; print(pathlib.Path(ament_package.__file__).parents[4])"
  OUTPUT_VARIABLE _wheels_prefix OUTPUT_STRIP_TRAILING_WHITESPACE COMMAND_ERROR_IS_FATAL ANY)
list(APPEND CMAKE_PREFIX_PATH "${_wheels_prefix}")
set(ENV{AMENT_PREFIX_PATH} "${_wheels_prefix}:$ENV{AMENT_PREFIX_PATH}")
foreach(_name IN ITEMS Python Python3)
  set(${_name}_EXECUTABLE "${Python3_EXECUTABLE}" CACHE FILEPATH "Python of the ROS wheels" FORCE)
endforeach()

# Before rosidl_generate_interfaces: leave out the C++ generators (the platform is Python: half of the compiling),
# keep every C one; and drop include directories of the machine that built the wheels, which CMake would refuse.
macro(ros_from_wheels_before_generate)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
  cmake_language(DEFER CALL ros_from_wheels_forget_foreign_includes "${CMAKE_CURRENT_SOURCE_DIR}")
endmacro()

function(ros_from_wheels_forget_foreign_includes directory)
  get_property(_targets DIRECTORY "${directory}" PROPERTY IMPORTED_TARGETS)
  foreach(_target IN LISTS _targets)
    get_target_property(_includes ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    if(_includes)
      list(FILTER _includes EXCLUDE REGEX "^/opt/python/")
      set_property(TARGET ${_target} PROPERTY INTERFACE_INCLUDE_DIRECTORIES "${_includes}")
    endif()
  endforeach()
endfunction()
