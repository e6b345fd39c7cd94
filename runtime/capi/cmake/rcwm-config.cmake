# find_package(rcwm) gives rcwm::rcwm, the shared library, and rcwm::static. Both need no other package.
get_filename_component(_rcwm_prefix "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
find_package(Threads REQUIRED)

if(NOT TARGET rcwm::rcwm)
  add_library(rcwm::rcwm SHARED IMPORTED)
  set_target_properties(rcwm::rcwm PROPERTIES
    IMPORTED_LOCATION "${_rcwm_prefix}/lib/librcwm.so"
    INTERFACE_INCLUDE_DIRECTORIES "${_rcwm_prefix}/include")
  add_library(rcwm::static STATIC IMPORTED)
  set_target_properties(rcwm::static PROPERTIES
    IMPORTED_LOCATION "${_rcwm_prefix}/lib/librcwm.a"
    INTERFACE_INCLUDE_DIRECTORIES "${_rcwm_prefix}/include"
    # Pieces in assembler do not say that they need no executable stack.
    INTERFACE_LINK_OPTIONS "LINKER:-z,noexecstack"
    INTERFACE_LINK_LIBRARIES "Threads::Threads;gcc_s;util;rt;m;${CMAKE_DL_LIBS}")
endif()

unset(_rcwm_prefix)
