# CMake settings for the ROS wheels of PyPI; included only when building against them.

# The wheels install into the prefix of the Python environment. Neither CMake nor ament searches it by default.
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

# Before rosidl_generate_interfaces: disable the C++ generators, which take half of the compile time and which Python
# nodes do not need. Keep every C generator.
macro(ros_from_wheels_before_generate)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
endmacro()

macro(ros_from_wheels_after_generate)
  ros_from_wheels_forget_foreign_includes()
  ros_from_wheels_compile_together()
endmacro()

# Drop the include directories of the machine that built the wheels. They do not exist here, and CMake would refuse them.
function(ros_from_wheels_forget_foreign_includes)
  get_property(_targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(_target IN LISTS _targets)
    get_target_property(_includes ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    if(_includes)
      list(FILTER _includes EXCLUDE REGEX "^/opt/python/")
      set_property(TARGET ${_target} PROPERTY INTERFACE_INCLUDE_DIRECTORIES "${_includes}")
    endif()
  endforeach()
endfunction()

# Compile sixteen generated files in one compiler run, because most of the time goes into their shared includes.
# Compile each type description separately: they define static data of the same names.
function(ros_from_wheels_compile_together)
  foreach(_part IN ITEMS rosidl_generator_c rosidl_generator_py rosidl_typesupport_c rosidl_typesupport_fastrtps_c
          rosidl_typesupport_introspection_c)
    set(_target ${PROJECT_NAME}__${_part})
    set_target_properties(${_target} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 16)
    get_target_property(_sources ${_target} SOURCES)
    list(FILTER _sources INCLUDE REGEX "__description\\.c$")
    if(_sources)
      set_source_files_properties(${_sources} PROPERTIES SKIP_UNITY_BUILD_INCLUSION ON)
    endif()
  endforeach()
endfunction()
