/* libmodbus as a peer of the tests.

   client tcp HOST PORT UNIT | client rtu DEVICE BAUD UNIT: use the simulated PLC as a program written by others does.
   server PORT: hold ten registers (value 100 + address) for one client of unit 1 until it hangs up.
   Each answer is a line "name: words", each refusal "name! text"; without an identity the client asks no further. */

#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static void show(const char *name, int got, const uint16_t *words)
{
    if (got < 0) {
        printf("%s! %s\n", name, modbus_strerror(errno));
        return;
    }
    printf("%s:", name);
    for (int i = 0; words != NULL && i < got; i++)
        printf(" %u", words[i]);
    printf("\n");
}

static int client(modbus_t *ctx, int unit)
{
    const uint16_t settings[5] = {250, 600, 9, 20, 2000}, beat = 77;
    uint16_t words[125];

    modbus_set_slave(ctx, unit);
    modbus_set_response_timeout(ctx, 0, 500000);
    if (modbus_connect(ctx) < 0) {
        fprintf(stderr, "connect: %s\n", modbus_strerror(errno));
        return 1;
    }
    int got = modbus_read_registers(ctx, 0x200, 50, words);
    show("identity", got, words);
    if (got < 0)
        return 0;
    show("input", modbus_read_input_registers(ctx, 0x200, 2, words), words);
    show("write", modbus_write_registers(ctx, 0x40, 5, settings), NULL);
    show("settings", modbus_read_registers(ctx, 0x40, 5, words), words);
    show("exchange", modbus_write_and_read_registers(ctx, 0x0F, 1, &beat, 0x100, 30, words), words);
    show("part of a command", modbus_write_register(ctx, 0x01, 1), NULL);
    show("impossible setting", modbus_write_registers(ctx, 0x50, 2, (const uint16_t[2]){501, 9999}), NULL);
    show("coils", modbus_read_bits(ctx, 0, 1, (uint8_t *)words), NULL);
    modbus_close(ctx);
    modbus_free(ctx);
    return 0;
}

static int server(int port)
{
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    modbus_t *ctx = modbus_new_tcp("127.0.0.1", port);
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 10, 10);
    int listener, length;

    for (int i = 0; i < 10; i++)
        map->tab_registers[i] = map->tab_input_registers[i] = 100 + i;
    listener = modbus_tcp_listen(ctx, 1);
    if (listener < 0) {
        fprintf(stderr, "listen: %s\n", modbus_strerror(errno));
        return 1;
    }
    printf("listening\n");
    fflush(stdout);
    modbus_tcp_accept(ctx, &listener);
    while ((length = modbus_receive(ctx, query)) >= 0)
        if (length > 0)
            modbus_reply(ctx, query, length, map);
    show("registers", 10, map->tab_registers);
    close(listener);
    modbus_mapping_free(map);
    modbus_close(ctx);
    modbus_free(ctx);
    return 0;
}

int main(int argc, char **argv)
{
    if (argc == 3 && strcmp(argv[1], "server") == 0)
        return server(atoi(argv[2]));
    if (argc == 6 && strcmp(argv[2], "tcp") == 0)
        return client(modbus_new_tcp(argv[3], atoi(argv[4])), atoi(argv[5]));
    if (argc == 6 && strcmp(argv[2], "rtu") == 0)
        return client(modbus_new_rtu(argv[3], atoi(argv[4]), 'N', 8, 1), atoi(argv[5]));
    fprintf(stderr, "client tcp HOST PORT UNIT | client rtu DEVICE BAUD UNIT | server PORT\n");
    return 2;
}
