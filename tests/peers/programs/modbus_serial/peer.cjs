// modbus-serial as a client of the simulated PLC: `peer.cjs PORT UNIT`, with the package found by NODE_PATH.
// It sends parallel requests without waiting for answers. One line of JSON comes out.
const ModbusRTU = require("modbus-serial");

async function main(port, unit) {
  const client = new ModbusRTU();
  await client.connectTCP("127.0.0.1", { port });
  client.setID(unit);
  client.setTimeout(2000);
  const seen = {};
  seen.identity = (await client.readHoldingRegisters(0x200, 50)).data;
  seen.input = (await client.readInputRegisters(0x200, 2)).data;
  await client.writeRegisters(0x40, [250, 600, 9, 20, 2000]);
  seen.settings = (await client.readHoldingRegisters(0x40, 5)).data;
  await client.writeRegister(0x0f, 77);
  seen.status = (await client.readHoldingRegisters(0x100, 30)).data;
  const spans = [0, 1, 2, 3, 4].map((i) => client.readHoldingRegisters(0x200 + i, 1));
  seen.parallel = (await Promise.all(spans)).map((answer) => answer.data[0]);
  seen.refused = await client.writeRegister(0x01, 1).then(() => 0, (error) => error.modbusCode);
  client.close(() => console.log(JSON.stringify(seen)));
}

main(Number(process.argv[2]), Number(process.argv[3])).catch((error) => {
  console.error(error);
  process.exit(1);
});
