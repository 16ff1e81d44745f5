#!/bin/sh
# Runs the operator of JADE. The environment variable CLASSPATH has the absolute paths of JADE and commons-codec.
exec java "$(dirname "$0")/StackOperator.java" "$@"
