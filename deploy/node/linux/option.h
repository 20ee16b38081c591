/* Numbers on a command line. */
#ifndef OPTION_H
#define OPTION_H

#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>

/* Read the number that follows an option; print what is allowed and return false if it is none, or out of its range. */
static inline bool option_number(const char *name, const char *text, double lowest, double highest, double *number)
{
    char *end = NULL;
    *number = text != NULL ? strtod(text, &end) : 0.0;
    if (text == NULL || end == text || *end != '\0' || !(*number >= lowest && *number <= highest)) {
        fprintf(stderr, "%s: value is %s; allowed: %.10g to %.10g\n", name, text != NULL ? text : "missing", lowest, highest);
        return false;
    }
    return true;
}

#endif
